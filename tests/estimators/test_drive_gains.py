"""Drive gains: from known loads at rest or a controller's log, in a file, and how well known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, FitError, RecordingError, SpecError
from hil.data import Dataset
from hil.estimators.base import RobotEstimator
from hil.estimators.drive_gains import (
    Gains,
    calibrate_gains,
    controller_gains,
    gain_lines,
    read_gains,
    write_gains,
)
from hil.estimators.drive_gains import (
    calibrated as declared_calibrated,
)
from hil.estimators.rigid_linear import RigidWls
from hil.evaluation.drive_gains import gains_of_sources
from hil.evaluation.payload import usual_gain_share
from hil.importers import import_recording
from hil.importers.sources import load_source
from tests.support.load_parts import BELIEVED, logged
from tests.support.synthetic_motion import (
    GAINS,
    K2,
    bent_currents,
    dwelling,
    fourier,
    moving,
    nominal,
    plant,
)

BESIDE = Payload(3.0, (0.05, 0.0, 0.05))
ON_AXIS = Payload(3.0, (0.0, 0.0, 0.05))


def sweep(*loads, poses=30, noise_a=0.002, stiction_nm=2.0, share=0.0, both=True, k2=None):
    """The same poses under each load; friction of the approach, growing with `share` of torque."""
    parts = []
    for number, load in enumerate(loads):
        data = dwelling(poses, load=load, noise_a=0.0, stiction_nm=stiction_nm, both=both, seed=2)
        if k2 is not None:
            data = data.with_columns(effort=bent_currents(data["effort"], k2))
        side = np.repeat([c.approach for c in data.conditions], 10)[:, None]
        whole = plant().with_payload(load) if load else plant()
        grows = side * share * np.abs(whole.gravity(data["q"])) / GAINS
        noise = noise_a * np.random.default_rng(number).normal(size=grows.shape)
        conditions = tuple(replace(c, load=number, id=f"{number}/{c.id}") for c in data.conditions)
        data = data.with_columns(effort=data["effort"] + grows + noise)
        # What a data sheet says: 5 % off.
        parts.append(replace(data, conditions=conditions, drive_gains=1.05 * GAINS))
    return Dataset.concatenate(parts)


def calibrated(*loads, **options) -> Gains:
    return calibrate_gains(sweep(*loads, **options), nominal())


@pytest.fixture(scope="module")
def gains() -> Gains:
    return calibrated(None, BESIDE)


def test_gains_are_found_within_their_errors(gains) -> None:
    deviation = (gains.gain[1:] - GAINS[1:]) / gains.gain_error[1:]
    assert np.max(np.abs(deviation)) < 3.5
    assert np.max(gains.gain_error[1:] / GAINS[1:]) < 0.005
    assert (gains.poses, gains.both_sides, gains.masses) == (30, True, (0.0, 3.0))


def test_vertical_axis_is_not_determined_and_says_why(gains) -> None:
    assert gains.determined.tolist() == [False, True, True, True, True, True]
    assert "vertical" in gains.reasons[0]
    assert np.isnan(gains.gain[0])


def test_a_load_on_the_flanges_axis_does_not_tell_the_last_joint() -> None:
    assert calibrated(None, ON_AXIS).determined.tolist() == [False, True, True, True, True, False]


def test_friction_that_grows_with_the_load_cancels_between_both_sides_only() -> None:
    both = calibrated(None, BESIDE, share=0.07)
    assert both.gain[1:] == pytest.approx(GAINS[1:], rel=0.005)
    below = sweep(None, BESIDE, share=0.07).select(lambda c: c.approach == 1)
    # From below, a raised arm holds part of its load by friction; which sign depends on the pose.
    one = calibrate_gains(below, nominal())
    assert not one.both_sides
    assert "load-dependent friction remains in the gains" in one.notes[0]
    assert np.max(one.gain_error[1:4] / both.gain_error[1:4]) > 2


def test_bent_drives_show_k1_and_k2() -> None:
    found = calibrated(None, Payload(5.0, (0.05, 0.0, 0.05)), k2=K2, poses=60, noise_a=0.001)
    assert found.k1[1:3] == pytest.approx(GAINS[1:3], rel=0.01)
    assert np.all(np.abs(found.k2 - K2)[1:3] < 4 * found.k2_error[1:3])
    assert found.gain[1] < GAINS[1] - 0.5


def test_noise_in_the_current_does_not_make_gains_small() -> None:
    data = sweep(None, BESIDE, poses=400, noise_a=1.2)
    torque, rise = (
        np.diff(x.reshape(2, 400, 20, 6).mean(axis=2), axis=0)[0, :, 3]
        for x in (sweep(None, BESIDE, poses=400, noise_a=0.0)["effort"] * GAINS, data["effort"])
    )
    plain = (rise @ torque) / (rise @ rise)
    assert calibrate_gains(data, nominal()).gain[3] == pytest.approx(GAINS[3], rel=0.12)
    assert plain < 0.75 * GAINS[3]


def test_a_joint_with_too_little_torque_against_its_friction_is_not_determined() -> None:
    found = calibrated(None, Payload(0.05, (0.0, 0.0, 0.02)), noise_a=0.2)
    assert not found.determined.any()
    assert "too little compared with friction" in found.reasons[3]


@pytest.mark.parametrize("joint", [1, 5])
def test_a_negative_gain_is_not_determined_and_says_what_it_may_come_from(joint) -> None:
    data = sweep(None, BESIDE)
    effort = data["effort"].copy()
    effort[:, joint] *= -1.0
    found = calibrate_gains(data.with_columns(effort=effort), nominal())
    assert found.determined.tolist() == [j not in (0, joint) for j in range(6)]
    assert np.isnan(found.gain[joint])
    assert "have the opposite sign" in found.reasons[joint]
    assert found.to_dict()["yaml"][0].count("-") == 0


def test_recordings_of_each_load_with_their_own_numbers_are_paired_by_position() -> None:
    data = sweep(None, BESIDE)
    apart = tuple(
        replace(c, pose=99 - c.pose, source="other") if c.load else c for c in data.conditions
    )
    assert calibrate_gains(replace(data, conditions=apart), nominal()).gain[1:] == pytest.approx(
        calibrate_gains(data, nominal()).gain[1:]
    )


def test_an_arm_that_sags_under_the_load_has_the_same_gains() -> None:
    data = sweep(None, BESIDE, noise_a=0.0, stiction_nm=0.0)
    loaded = np.repeat([c.load for c in data.conditions], 10)[:, None]
    whole, q = plant().with_payload(BESIDE), data["q"]
    # 4 mrad at 15 N·m, as a controller without an integral part gives way.
    low = q - 0.004 / 15 * (whole.gravity(q) - plant().gravity(q))
    effort = data["effort"] + loaded * (whole.gravity(low) - whole.gravity(q)) / GAINS
    sagging = data.with_columns(q=np.where(loaded, low, q), effort=effort)
    assert 0.003 < np.max(np.abs(low - q)) < 0.01
    found = calibrate_gains(sagging, nominal())
    assert found.gain[1:] == pytest.approx(GAINS[1:], rel=1e-4)


def test_poses_without_a_partner_are_counted_in_a_note() -> None:
    data = sweep(None, BESIDE)
    assert calibrate_gains(data, nominal()).notes == ()
    # Pose 3 lacks one approach under load, poses 4 and 5 were never visited with it.
    partial = data.select(
        lambda c: not c.load or (c.pose not in (4, 5) and (c.pose, c.approach) != (3, -1))
    )
    found = calibrate_gains(partial, nominal())
    assert (found.poses, found.both_sides) == (27, True)
    assert (
        "3 of 30 poses are not used: they were not approached from both directions"
        in found.notes[0]
    )


def test_three_loads_are_all_used() -> None:
    found = calibrated(None, Payload(1.5, BESIDE.com), BESIDE)
    assert found.masses == (0.0, 1.5, 3.0)
    assert found.gain[1:] == pytest.approx(GAINS[1:], rel=0.01)


def test_yaml_lines_keep_what_was_declared_where_nothing_was_found(gains) -> None:
    document = yaml.safe_load("\n".join(gains.yaml_lines()))
    assert document["drive_gains_nm_a"][0] == pytest.approx(1.05 * GAINS[0], abs=1e-3)
    assert document["drive_gains_nm_a"][1:] == pytest.approx(gains.gain[1:], abs=1e-3)
    assert "shoulder_pan_joint as declared" in document["drive_gains_source"]
    nothing = calibrate_gains(replace(sweep(None, BESIDE), drive_gains=None), nominal())
    assert nothing.yaml_lines() == []


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (lambda: sweep(None), "at least two payloads, the data have 0 kg only"),
        (lambda: sweep(None, BESIDE, poses=4), "4 poses .* are too few"),
        (lambda: replace(sweep(None, BESIDE), effort_kind="torque"), "the data contain a torque"),
        (lambda: moved(sweep(None, BESIDE)), "0 poses .* are too few"),
        (lambda: wild(sweep(None, BESIDE)), "1 .* of elbow_joint are impossible"),
    ],
)
def test_data_that_cannot_tell_are_refused(data, message) -> None:
    with pytest.raises(FitError, match=message):
        calibrate_gains(data(), nominal())


def test_no_source_is_no_recording() -> None:
    with pytest.raises(DataError, match="no recording"):
        gains_of_sources([])


def wild(data):
    """One sample is garbage."""
    effort = data["effort"].copy()
    effort[7, 2] = 1e6
    return data.with_columns(effort=effort)


def moved(data):
    """The loaded program at other poses than the bare one."""
    loaded = np.repeat([c.load for c in data.conditions], 10)[:, None]
    return data.with_columns(q=data["q"] + 0.02 * loaded)


# From the controller's own currents and torques


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
    assert "elbow_joint: the gain varies between series from 9.90 to 11.00" in notes[2]


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
    told = run("drive-gains", recording, "-o", tmp_path / "gains.yaml")
    assert told.startswith("method: controller (logged currents and torques in 1500 samples)")
    assert read_gains(tmp_path / "gains.yaml").values == pytest.approx(BELIEVED, rel=0.02)
    fitted = json.loads(
        run("fit", recording, "-e", "rigid-wls", "--gains", tmp_path / "gains.yaml",
            "-o", tmp_path / "models", "--json")
    )  # fmt: skip
    document = json.loads((Path(fitted["model"]) / "model.json").read_text("utf-8"))
    assert document["fitted"]["gains_source"].startswith("the controller's current per torque")


def test_the_method_asked_for_is_the_one_used(recording: Path) -> None:
    assert json.loads(run("drive-gains", recording, "--json"))["method"] == "controller"
    with pytest.raises(FitError, match="at least two payloads"):
        run("drive-gains", recording, "--method", "known-loads")
    with pytest.raises(SpecError, match="unknown method 'controler'"):
        run("drive-gains", recording, "--method", "controler")


def test_files_without_usable_gains_are_refused(tmp_path: Path) -> None:
    for text in ("drive_gains_nm_a: [1, -2]", "drive_gains_nm_a: 3", "other: 1"):
        (tmp_path / "g.yaml").write_text(text, "utf-8")
        with pytest.raises(SpecError, match="drive_gains_nm_a is missing"):
            read_gains(tmp_path / "g.yaml")
    with pytest.raises(RecordingError, match="already exists"):
        write_gains(tmp_path / "g.yaml", ["drive_gains_nm_a: [1]"])
    (tmp_path / "two.yaml").write_text("drive_gains_nm_a: [1, 2]", "utf-8")
    with pytest.raises(DataError, match="expected 6 drive gains, one per joint, got 2"):
        read_gains(tmp_path / "two.yaml").of(moving(1))


# How well they are known, by where they come from


def fitted_with(source: str, kind: str = "current") -> RobotEstimator:
    model = RigidWls().fit(moving(1, 2, kind=kind), nominal())
    model.gains_source_ = source
    return model


@pytest.mark.parametrize(
    ("source", "share"),
    [
        ("", 0.05),
        ("data sheet", 0.05),
        ("calibrated with 0, 3 kg at 40 poses", 0.01),
        ("calibrated with 0, 3 kg at 40 poses; shoulder_pan_joint as declared before", 0.05),
        ("the controller's current per torque over 900 samples", 0.01),
    ],
)
def test_gains_of_this_very_arm_are_known_better(source: str, share: float) -> None:
    assert usual_gain_share(fitted_with(source)) == share


def test_torques_have_no_gains() -> None:
    assert usual_gain_share(fitted_with("", "torque")) == 0.0


def test_what_hil_gains_writes_is_recognised() -> None:
    names, gain = ("a", "b"), np.array([10.0, 11.0])
    source = "calibrated with 0, 3 kg at 40 poses"
    for reasons, known in ((("", ""), True), (("", "hardly moved"), False)):
        line = gain_lines(names, gain, reasons, gain, source)[1]
        assert declared_calibrated(line.split('"')[1]) is known
