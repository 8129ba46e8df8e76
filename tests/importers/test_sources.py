"""Run directories and MCAP files become datasets whose series know their conditions."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError
from hil.data.filters import sample_rate
from hil.data.splits import groups
from hil.importers.sources import load_source, serial_of
from hil.recording import Attachment, McapWriter, RunDirectory
from hil.robot import Status
from hil.robot.state import STATE_TOPIC, state_topic

NAMES = [f"joint_{i}" for i in range(1, 7)]
RATE = 125.0
ROBOT = {
    "model": "ur5",
    "joint_names": NAMES,
    "effort_kind": "current",
    "drive_gains": [10, 10, 10, 8, 8, 8],
    "drive_gains_source": "the test",
}
PLAN = {
    "dwell": {"samples": 10},
    "loads": [
        {"mass_kg": 0.0, "com_m": [0, 0, 0], "inertia_kgm2": [0] * 6},
        {"mass_kg": 3.0, "com_m": [0, 0, 0.05], "inertia_kgm2": [0.1] * 3 + [0] * 3},
    ],
    "steps": [
        {"index": 0, "kind": "payload", "load": 0},
        {"index": 1, "kind": "move", "load": 0},
        {"index": 2, "kind": "dwell", "load": 0, "pose": 4, "approach": 1},
        {"index": 3, "kind": "trajectory", "load": 0, "trajectory": 7},
        {"index": 4, "kind": "dwell", "load": 1, "pose": 4, "approach": -1},
    ],
}


def topic():
    return state_topic(6, RATE, clock="virtual", effort_unit="A")


def rows(segments, *, first=0, value=None):
    """One row per entry of `segments`; joint 1 stands at the row's own number, or at `value`."""
    block = topic().blank(len(segments))
    number = np.arange(first, first + len(segments))
    block["device_time"] = number / RATE
    block["host_time"] = 1.8e9 + number / RATE
    block["q"] = block["effort"] = (number if value is None else np.full(len(number), value))[
        :, None
    ]
    block["qd"] = 0.0
    block["segment"] = segments
    return block


FULL = [1] * 40 + [2] * 30 + [3] * 100 + [4] * 25


def run_with(tmp_path, *attempts, plan=PLAN, stop=True, unsettled=(), robot=ROBOT):
    run = RunDirectory.create(tmp_path / "runs", "ur5", "test")
    run.write_json("plan.json", plan)
    run.write_start({"uid": "u", "robot": robot})
    for attempt, block in enumerate(attempts):
        with McapWriter(run.part_path(attempt), [topic()], joint_names=NAMES) as writer:
            writer.write(STATE_TOPIC, block)
    if stop:
        run.write_stop("completed", "", {"unsettled": list(unsettled)})
    return run.path


def test_every_step_that_measures_becomes_a_series(tmp_path) -> None:
    data = load_source(run_with(tmp_path, rows(FULL)))
    assert [(c.kind, c.pose, c.trajectory, c.approach, c.load) for c in data.conditions] == [
        ("move", -1, -1, 0, 0),
        ("dwell", 4, -1, 1, 0),
        ("trajectory", -1, 7, 0, 0),
        ("dwell", 4, -1, -1, 1),
    ]
    assert data.conditions[3].payload == Payload(3.0, (0, 0, 0.05), (0.1, 0.1, 0.1, 0, 0, 0))
    assert (data.robot, data.effort_kind, data.drive_gains_source) == ("ur5", "current", "the test")
    assert data.drive_gains is not None
    assert data.drive_gains.tolist() == ROBOT["drive_gains"]


def test_a_dwell_is_its_last_ten_samples(tmp_path) -> None:
    data = load_source(run_with(tmp_path, rows(FULL))).of_kind("dwell")
    assert data["q"][:, 0].tolist() == [*range(60, 70), *range(185, 195)]


def test_quantities_nobody_recorded_are_no_columns(tmp_path) -> None:
    data = load_source(run_with(tmp_path, rows(FULL)))
    assert set(data.columns) == {"t", "q", "qd", "effort"}


def test_step_repeated_after_a_resume_counts_as_recorded_last(tmp_path) -> None:
    broken = rows([1] * 40 + [2] * 30 + [3] * 50)
    resumed = rows([3] * 100 + [4] * 25, first=500)
    data = load_source(run_with(tmp_path, broken, resumed))
    assert [(c.kind, c.attempt) for c in data.conditions] == [
        ("move", 0),
        ("dwell", 0),
        ("trajectory", 1),
        ("dwell", 1),
    ]
    assert data.of_kind("trajectory")["q"][0, 0] == 500


def test_dwells_that_ran_into_their_time_out_are_marked(tmp_path) -> None:
    data = load_source(run_with(tmp_path, rows(FULL), unsettled=[4]))
    assert [c.settled for c in data.of_kind("dwell").conditions] == [True, False]


@pytest.mark.parametrize("bit", [Status.MASKED, Status.SLOWED])
def test_unusable_rows_and_repeated_stamps_are_left_out(tmp_path, bit: Status) -> None:
    block = rows(FULL)
    block["status"][100:103] |= int(bit)
    block["device_time"][110] = block["device_time"][109]
    data = load_source(run_with(tmp_path, block)).of_kind("trajectory")
    assert len(data) == 96
    assert not {100.0, 101.0, 102.0, 110.0} & set(data["q"][:, 0])


def test_pause_in_the_time_stamps_cuts_a_trajectory(tmp_path) -> None:
    block = rows(FULL)
    block["device_time"][120:] += 1.0
    data = load_source(run_with(tmp_path, block)).of_kind("trajectory")
    assert np.diff(data.offsets).tolist() == [50, 50]
    assert [c.id.rsplit(":")[-1] for c in data.conditions] == ["trajectory3", "trajectory3/1"]
    assert len(groups(data, "trajectory")) == 1


@pytest.mark.parametrize("lost", [4, 9])
def test_some_lost_samples_cut_too_since_no_filter_may_run_across_them(tmp_path, lost) -> None:
    block = rows(FULL)
    block["device_time"][120:] += lost / RATE
    data = load_source(run_with(tmp_path, block)).of_kind("trajectory")
    assert np.diff(data.offsets).tolist() == [50, 50]
    for _, part in data.slices():
        assert sample_rate(data["t"][part]) == pytest.approx(RATE)
        assert np.max(np.diff(data["t"][part])) < 1.5 / RATE


def test_only_the_kinds_asked_for_are_cut(tmp_path) -> None:
    path = run_with(tmp_path, rows(FULL))
    everything, dwells = load_source(path), load_source(path, kinds=("dwell",))
    assert [c.kind for c in dwells.conditions] == ["dwell", "dwell"]
    wanted = everything.of_kind("dwell")
    assert dwells.conditions == wanted.conditions
    assert all(np.array_equal(dwells[name], wanted[name]) for name in wanted.columns)


def test_step_that_was_begun_again_counts_once_though_the_move_between_is_not_wanted(
    tmp_path,
) -> None:
    again = [1] * 40 + [3] * 100 + [1] * 40 + [3] * 60
    path = run_with(tmp_path, rows(again))
    data = load_source(path, kinds=["trajectory"])
    assert len(data.conditions) == 1
    assert data["q"][:, 0].tolist() == list(range(180, 240))


def test_serial_number_is_what_the_run_says(tmp_path) -> None:
    path = run_with(tmp_path, rows(FULL), robot={**ROBOT, "identity": {"serial": "A7"}})
    assert serial_of(path) == "A7"


def test_robot_without_a_serial_number_has_none(tmp_path) -> None:
    assert serial_of(run_with(tmp_path, rows(FULL))) == ""


def test_interrupted_run_gives_what_was_recorded(tmp_path) -> None:
    path = run_with(tmp_path, rows(FULL), stop=False)
    recording = path / "recording" / "00.mcap"
    torn = recording.read_bytes()[:-200]
    recording.unlink()
    (path / "recording" / "00.mcap.partial").write_bytes(torn)
    assert [c.kind for c in load_source(path).conditions] == [
        "move",
        "dwell",
        "trajectory",
        "dwell",
    ]


def test_recording_of_a_run_explains_itself_without_its_directory(tmp_path) -> None:
    attachments = [
        Attachment("plan.json", "application/json", json.dumps(PLAN).encode()),
        Attachment("start.json", "application/json", json.dumps({"robot": ROBOT}).encode()),
    ]
    path = tmp_path / "alone.mcap"
    with McapWriter(path, [topic()], attachments=attachments) as writer:
        writer.write(STATE_TOPIC, rows(FULL))
    assert [c.kind for c in load_source(path).conditions] == [
        "move",
        "dwell",
        "trajectory",
        "dwell",
    ]


def test_mcap_that_names_no_robot_is_refused_with_the_way_to_import(tmp_path) -> None:
    path = tmp_path / "foreign.mcap"
    with McapWriter(path, [topic()]) as writer:
        writer.write(STATE_TOPIC, rows(FULL))
    with pytest.raises(DataError, match="does not describe the robot") as caught:
        load_source(path)
    assert "hil import" in caught.value.hint


def test_run_that_measured_nothing_is_refused(tmp_path) -> None:
    with pytest.raises(DataError, match="no usable samples"):
        load_source(run_with(tmp_path, rows([-1] * 50)))


def test_missing_source_is_refused(tmp_path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        load_source(tmp_path / "nowhere")


def test_damaged_plan_is_refused_with_its_file(tmp_path) -> None:
    plan = {**PLAN, "steps": [{"kind": "dwell"}]}
    with pytest.raises(DataError, match=r"plan\.json is not a plan"):
        load_source(run_with(tmp_path, rows(FULL), plan=plan))
