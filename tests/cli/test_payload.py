"""`hil payload` at the command line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.importers import import_recording
from tests.support.export_models import exact
from tests.support.synthetic_motion import LOAD, fourier, moving

MAP = """
hil_map: 1
description: synthetic
format: csv
robot: ur5
joint_names: [shoulder_pan_joint, shoulder_lift_joint, elbow_joint, wrist_1_joint, wrist_2_joint,
              wrist_3_joint]
effort_kind: current
columns:
  t: {columns: 1}
  q: {columns: "2:7", unit: rad}
  qd: {columns: "8:13", unit: rad/s}
  effort: {columns: "14:19", unit: A}
"""


@pytest.mark.thorough
@pytest.mark.parametrize("load", [None, LOAD])
def test_it_tells_the_load_or_that_none_shows(load: Payload | None, tmp_path: Path) -> None:
    run = moving(5, load=load)
    t, q, qd, _ = fourier(5)
    np.savetxt(tmp_path / "run.csv", np.column_stack([t, q, qd, run["effort"]]), delimiter=",")
    (tmp_path / "map.yaml").write_text(MAP, "utf-8")
    recording = tmp_path / "run.mcap"
    import_recording(tmp_path / "run.csv", map_file=tmp_path / "map.yaml", out=recording)
    folder = exact().save(tmp_path / "model")
    command = ["payload", str(folder), str(recording)]
    lines = CliRunner().invoke(app, command, catch_exceptions=False).stdout.splitlines()
    assert lines[0].startswith("payload from 600 samples")
    if load is None:
        assert lines[-1].startswith("no payload detected: 0.0")
    else:
        told = re.findall(r"(?:mass_kg: |--payload )([0-9.]+)", "\n".join(lines[-2:]))
        assert np.array(told, dtype=float) == pytest.approx([load.mass] * 2, rel=0.05)
