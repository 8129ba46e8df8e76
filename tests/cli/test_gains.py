"""`hil drive-gains` on a run of the mock: a table for people, one document for programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import FitError
from hil_mock_robot.plant.truth import draw_truth
from tests.support.paths import EXPERIMENTS

SPEC = EXPERIMENTS / "ur5_gains.yaml"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gains")
    text = SPEC.read_text("utf-8").replace("waypoints: 40", "waypoints: 8")
    text = text.replace("{duration_s: 60}", "{duration_s: 5}").replace(
        "fit:\n", "weigh: false\nfit:\n"
    )
    short = folder / "short.yaml"
    short.write_text(text.replace("  - estimator: static-wls", "  []"), "utf-8")
    return Path(hil.run(hil.load(short), runs=folder / "runs").run)


def told(*arguments: object) -> str:
    done = CliRunner().invoke(app, ["drive-gains", *map(str, arguments)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.stdout


@pytest.mark.thorough
def test_gains_of_the_mock_are_found(run: Path) -> None:
    document = json.loads(told(run, "--json"))
    truth = np.array([joint.drive.gain_nm_a for joint in draw_truth("ur5", 0).joints])
    # Eight poses are too few for the last joint's small torque; the proof has forty.
    found = np.array(document["gain_nm_a"][1:5], dtype=float)
    assert document["gain_nm_a"][0] is None
    assert "vertical" in document["not_determined"]["shoulder_pan_joint"]
    assert found == pytest.approx(truth[1:5], rel=0.04)
    assert (document["poses"], document["both_sides"]) == (8, True)


@pytest.mark.thorough
def test_people_are_told_gains_reasons_and_lines_to_copy(run: Path) -> None:
    text = told(run)
    assert "known loads (0, 3 kg at 8 poses)" in text
    assert "shoulder_pan_joint: the payloads cause no torque about the axis of this joint" in text
    assert "\ndrive_gains_nm_a: [10.150, " in text


@pytest.mark.thorough
def test_a_run_with_one_load_is_refused(run: Path, tmp_path: Path) -> None:
    from tests.support.report_runs import dwell_plan, write_run

    other = write_run(tmp_path, dwell_plan(poses=6))
    with pytest.raises(FitError, match="at least two payloads"):
        told(other.path)
