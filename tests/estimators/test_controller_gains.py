"""Drive gains from a controller's own currents and torques, and the file they go into."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError, FitError, RecordingError, SpecError
from hil.estimators.drive_gains import controller_gains, read_gains, write_gains
from hil.importers import import_recording
from hil.importers.sources import load_source
from tests.support.synthetic_motion import COULOMB, GAINS, VISCOUS, fourier, moving, nominal

BELIEVED = 1.1 * GAINS


def logged(*seeds, noise=0.03, correlation=0.95):
    """A controller that computes torques, and adds a control error that lasts a while."""
    data = moving(*seeds, samples=1500)
    motion = [data[name] for name in ("q", "qd", "qdd_f")]
    torque = nominal().inverse_dynamics(*motion)
    random = np.random.default_rng(sum(seeds))
    size = noise * np.std(torque / BELIEVED, axis=0)
    white = size * np.sqrt(1 - correlation**2) * random.normal(size=torque.shape)
    error = lfilter([1.0], [1.0, -correlation], white, axis=0)
    own = (0.8 * COULOMB * np.tanh(data["qd"] / 0.01) + 0.9 * VISCOUS * data["qd"]) / GAINS
    current = torque / BELIEVED + own + error
    declared = replace(data, drive_gains=np.full(6, 12.0))
    return declared.with_columns(torque_target=torque, effort_target=current)


def test_what_the_controller_believes_is_found_whatever_the_motor_does() -> None:
    found = controller_gains(logged(1, 2, noise=0.0))
    assert found.gain == pytest.approx(BELIEVED, rel=1e-9)
    assert found.determined.all()


def test_joints_without_torque_are_not_determined_and_keep_what_is_declared() -> None:
    data = logged(1, 2)
    torque = data["torque_target"].copy()
    torque[:, 0] = 0.0
    found = controller_gains(data.with_columns(torque_target=torque))
    assert found.determined.tolist() == [False, *5 * [True]]
    assert found.yaml_lines()[0].startswith("drive_gains_nm_a: [12.000, 12.1")
    assert "shoulder_pan_joint as declared before" in found.yaml_lines()[1]


def test_gains_that_depend_on_the_recording_are_told() -> None:
    data = logged(1, 2, noise=0.0)
    late = data.series_index()[:, None] == 1
    current = np.where(late, 0.9 * data["effort_target"], data["effort_target"])
    notes = controller_gains(data.with_columns(effort_target=current)).notes
    assert len(notes) == 6
    assert "elbow_joint: series by series 9.90 to 11.00" in notes[2]


def test_recordings_without_the_controllers_torques_are_refused() -> None:
    with pytest.raises(FitError, match="lacks torque_target, effort_target"):
        controller_gains(moving(1))


MAP = """
hil_map: 1
description: controller's log
format: csv
robot: ur5
joint_names: [j1, j2, j3, j4, j5, j6]
effort_kind: current
columns:
  t: {columns: 1}
  q: {columns: "2:7", unit: rad}
  qd: {columns: "8:13", unit: rad/s}
  effort: {columns: "14:19", unit: A}
  effort_target: {columns: "20:25", unit: A}
  torque_target: {columns: "26:31", unit: mN·m, optional: true}
"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    data = logged(1, noise=0.01)
    names = ("q", "qd", "effort", "effort_target")
    table = np.column_stack(
        [data["t"], *(data[name] for name in names), 1000 * data["torque_target"]]
    )
    np.savetxt(tmp_path / "log.csv", table, delimiter=",")
    (tmp_path / "map.yaml").write_text(MAP, "utf-8")
    out = tmp_path / "log.mcap"
    import_recording(tmp_path / "log.csv", map_file=tmp_path / "map.yaml", out=out)
    return out


def test_imports_keep_the_controllers_torques_beside_the_state(recording: Path) -> None:
    data = load_source(recording)
    motion = fourier(1, 1500)[1:]
    assert data["torque_target"] == pytest.approx(nominal().inverse_dynamics(*motion), abs=1e-9)


def test_a_log_without_those_columns_is_imported_without_them(recording: Path) -> None:
    folder = recording.parent
    short = np.loadtxt(folder / "log.csv", delimiter=",")[:, :25]
    np.savetxt(folder / "short.csv", short, delimiter=",")
    import_recording(folder / "short.csv", map_file=folder / "map.yaml", out=folder / "short.mcap")
    assert "torque_target" not in load_source(folder / "short.mcap").columns


def run(*arguments: object):
    done = CliRunner().invoke(app, list(map(str, arguments)))
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.stdout


def test_gains_go_into_a_file_that_a_fit_takes(recording: Path, tmp_path: Path) -> None:
    told = run("gains", recording, "-o", tmp_path / "gains.yaml")
    assert told.startswith("method: controller, its currents and torques in 1500 samples")
    assert read_gains(tmp_path / "gains.yaml").values == pytest.approx(BELIEVED, rel=0.02)
    fitted = json.loads(
        run("fit", recording, "-e", "rigid-wls", "--gains", tmp_path / "gains.yaml",
            "-o", tmp_path / "models", "--json")
    )  # fmt: skip
    document = json.loads((Path(fitted["model"]) / "model.json").read_text("utf-8"))
    assert document["fitted"]["gains_source"].startswith("the controller's current per torque")


def test_the_method_asked_for_is_the_one_used(recording: Path) -> None:
    assert json.loads(run("gains", recording, "--json"))["method"] == "controller"
    with pytest.raises(FitError, match="at least two loads"):
        run("gains", recording, "--method", "known-loads")
    with pytest.raises(SpecError, match="no way 'controler'"):
        run("gains", recording, "--method", "controler")


def test_files_without_usable_gains_are_refused(tmp_path: Path) -> None:
    for text in ("drive_gains_nm_a: [1, -2]", "drive_gains_nm_a: 3", "other: 1"):
        (tmp_path / "g.yaml").write_text(text, "utf-8")
        with pytest.raises(SpecError, match="no drive_gains_nm_a"):
            read_gains(tmp_path / "g.yaml")
    with pytest.raises(RecordingError, match="exists already"):
        write_gains(tmp_path / "g.yaml", ["drive_gains_nm_a: [1]"])
    (tmp_path / "two.yaml").write_text("drive_gains_nm_a: [1, 2]", "utf-8")
    with pytest.raises(DataError, match="2 drive gains were given for 6 joints"):
        read_gains(tmp_path / "two.yaml").of(moving(1))
