"""Options and injected faults of the embedded mock: what the host sees of each, and when."""

import re
import threading

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import (
    CommandRefused,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    SpecError,
)
from hil.robot import Status
from hil_mock_robot.embedded.faults import EmbeddedFault
from hil_mock_robot.embedded.options import Options
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.in_time import InTime, measured_again
from tests.support.mock_motions import ASIDE, UPRIGHT, move, play
from tests.support.paths import DOCS

DT = 1 / 125


def robot_with(*faults, **options):
    mock = MockRobot("bench", seed=3, faults=list(faults), **options)
    mock.connect()
    return mock


def sound():
    return robot_with()


def rows_of(mock, count):
    rows = mock.read()
    while len(rows) < count:
        rows = np.concatenate((rows, mock.read()))
    return rows[:count]


def moving(mock, count=60):
    """The first rows of a move that is under way."""
    mock.prepare(move())
    mock.start()
    return rows_of(mock, count)


def test_a_fault_that_never_comes_leaves_no_trace():
    late = robot_with({"kind": "freeze", "at_s": 1000.0}, {"kind": "nan", "segment": 99})
    assert moving(late).tobytes() == moving(sound()).tobytes()


@pytest.mark.parametrize(
    ("when", "first"),
    [({"at_s": 0.2}, 25), ({"at_s": 0.201}, 26), ({"segment": 7, "after_s": 0.1}, 16 + 13)],
)
def test_a_fault_begins_with_the_first_sample_that_is_due(when, first):
    mock = robot_with({"kind": "nan", **when})
    rows = mock.read()
    mock.prepare(move(index=7))
    mock.start()
    rows = np.concatenate((rows, rows_of(mock, 60)))
    ill = np.flatnonzero(np.isnan(rows["q"]).all(axis=1))
    assert ill[0] + 1 == first
    assert len(ill) == len(rows) - first + 1


def test_a_fault_lasts_as_long_as_it_says():
    rows = rows_of(robot_with({"kind": "nan", "at_s": 0.2, "for_s": 0.08}), 60)
    assert np.isnan(rows["effort"]).all(axis=1).nonzero()[0].tolist() == list(range(24, 34))


@pytest.mark.parametrize(("kind", "code"), [("protective_stop", 4), ("emergency_stop", 5)])
def test_a_stop_of_the_controller_is_told_once_and_raised_until_reconnected(kind, code):
    mock = robot_with({"kind": kind, "segment": 0, "after_s": 0.4})
    rows = moving(mock, 49)
    assert not (rows["status"] & Status.FAULT).any()
    told = mock.read()
    assert (told["status"] & Status.FAULT).all()
    assert (told["fault_code"] == code).all()
    for _ in range(2):
        with pytest.raises(RobotFault, match=kind.replace("_", " ")):
            mock.read()
    with pytest.raises(CommandRefused, match="injected"):
        mock.prepare(move())
    mock.stop()
    mock.connect()
    rows = rows_of(mock, 50)
    assert rows["status"][-1] == Status.HOLDING
    play(mock, move(rows["q_target"][-1], UPRIGHT, 1))


def test_an_emergency_stop_brakes_harder_than_a_protective_stop():
    way = {}
    for kind in ("protective_stop", "emergency_stop"):
        mock = robot_with({"kind": kind, "segment": 0, "after_s": 0.8})
        before = moving(mock, 99)[-1]["q"]
        mock.read()
        with pytest.raises(RobotFault):
            mock.read()
        mock.connect()
        way[kind] = np.abs(mock.read()["q"][-1] - before).max()
    assert 0.02 < way["emergency_stop"] < 0.7 * way["protective_stop"]


def test_frozen_rows_repeat_while_the_arm_moves_on():
    mock = robot_with({"kind": "freeze", "segment": 0, "after_s": 0.4, "for_s": 0.8})
    rows, same = moving(mock, 160), moving(sound(), 160)
    frozen = rows["device_time"] == rows["device_time"][48]
    assert frozen.sum() == 101
    assert (rows["q"][frozen] == rows["q"][48]).all()
    assert rows[149:].tobytes() == same[149:].tobytes()
    assert np.abs(rows["q"][149] - rows["q"][148]).max() > 0.1


def test_silence_times_out_by_device_time_and_leaves_a_gap():
    mock = robot_with({"kind": "silence", "segment": 0, "after_s": 0.4, "for_s": 0.5})
    assert len(moving(mock, 49)) == 49
    with pytest.raises(RobotTimeout, match=r"within 0\.3 s"):
        mock.read(timeout_s=0.3)
    rows = mock.read(timeout_s=0.3)
    assert rows["device_time"][0] == pytest.approx((49 + 63 + 1) * DT)


def test_a_cut_line_carries_neither_rows_nor_commands_until_connected_anew():
    mock = robot_with({"kind": "cut", "at_s": 0.1})
    rows_of(mock, 12)
    for call in (mock.read, mock.stop, mock.start, lambda: mock.prepare(move())):
        with pytest.raises(RobotConnectionError, match="cut"):
            call()
    mock.close()
    mock.connect()
    assert len(mock.read()) == 16


def test_lagging_rows_come_late_and_complete():
    mock = robot_with({"kind": "lag", "at_s": 0.4, "by_s": 0.2})
    rows = rows_of(mock, 120)
    assert np.diff(rows["device_time"]) == pytest.approx(np.full(119, DT))
    late = (rows["host_time"] - rows["device_time"]) - (
        rows["host_time"][0] - rows["device_time"][0]
    )
    assert np.abs(late[:49]).max() < 1e-6
    assert late[49:] == pytest.approx(0.2, abs=16 * DT)


def test_a_lag_longer_than_the_patience_of_the_reader_is_a_time_out():
    mock = robot_with({"kind": "lag", "at_s": 0.008, "by_s": 3.0})
    with pytest.raises(RobotTimeout):
        mock.read(timeout_s=1.0)


def test_dropped_samples_are_a_gap_and_duplicates_come_twice():
    mock = robot_with(
        {"kind": "drop", "at_s": 0.2, "samples": 5},
        {"kind": "duplicate", "at_s": 0.4, "samples": 3},
    )
    ticks = np.diff(rows_of(mock, 100)["device_time"]) / DT
    assert ticks[23] == pytest.approx(6)
    assert (np.abs(ticks) < 1e-9).sum() == 3
    assert np.isclose(ticks, 1).sum() == 99 - 4


@pytest.mark.parametrize("by_s", [3.0, -3.0])
def test_the_device_clock_jumps_and_goes_on_from_there(by_s):
    rows = rows_of(robot_with({"kind": "clock_jump", "at_s": 0.2, "by_s": by_s}), 60)
    steps = np.diff(rows["device_time"])
    assert steps[23] == pytest.approx(by_s + DT)
    assert np.delete(steps, 23) == pytest.approx(np.full(58, DT))


def test_a_refusal_by_segment_refuses_that_one_once():
    mock = robot_with({"kind": "refuse", "segment": 4})
    play(mock, move(index=3))
    with pytest.raises(CommandRefused, match=r"segment 4 .*injected"):
        mock.prepare(move(ASIDE, UPRIGHT, 4))
    mock.prepare(move(ASIDE, UPRIGHT, 4))


def test_a_refusal_by_time_refuses_the_next_segment():
    mock = robot_with({"kind": "refuse", "at_s": 0.1})
    mock.prepare(move())
    mock.read()
    with pytest.raises(CommandRefused, match="injected"):
        mock.prepare(move())
    mock.prepare(move())


@measured_again
def test_a_hanging_read_can_be_stopped_and_ends_when_the_robot_is_closed():
    mock = robot_with({"kind": "hang", "segment": 0, "after_s": 0.2})
    moving(mock, 24)
    seen = []

    def read():
        try:
            mock.read(timeout_s=0.01)
        except RobotConnectionError as error:
            seen.append(error)

    hung = threading.Thread(target=read, daemon=True)
    hung.start()
    hung.join(0.1)
    assert hung.is_alive()
    own = InTime()
    mock.stop()
    mock.close()
    took = own.taken()
    hung.join(10.0)
    assert "not connected" in seen[0].message
    took.require(0.1)


def test_a_faulty_controller_refuses_a_payload():
    mock = robot_with({"kind": "protective_stop", "at_s": 0.1})
    rows_of(mock, 20)
    with pytest.raises(CommandRefused, match="protective stop"):
        mock.set_payload(Payload(1.0))


def test_stopping_again_changes_nothing_of_the_braking():
    def braked(stops):
        mock = sound()
        moving(mock, 96)
        blocks = []
        for k in range(6):
            if k < stops:
                mock.stop()
            blocks.append(mock.read())
        return np.concatenate(blocks)

    once, often = braked(1), braked(5)
    assert once["q_target"].tobytes() == often["q_target"].tobytes()
    assert once["status"][-1] == Status.HOLDING


# What a station may say about the mock's clock, journal and faults.


PAGE = DOCS / "reference" / "mock.md"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"clock": "real"}, "clock is 'real'"),
        ({"clock": "wall", "speed": 50}, "speed is 50"),
        ({"clock": "wall", "speed": True}, "speed is True"),
        ({"clock": "wall", "watchdog_s": -1}, "watchdog_s is -1"),
        ({"clock": "wall", "queue_s": "long"}, "queue_s is 'long'"),
        ({"clock": "wall", "rate_hz": 50, "speed": 0.1}, "yields 5 samples per second"),
        ({"clock": "wall", "block": 16}, "block is not used with clock: wall"),
        ({"speed": 2.0}, "speed is not used with clock: virtual"),
        ({"watchdog_s": 1.0}, "watchdog_s is not used"),
        ({"journal": 5}, "journal is 5"),
        ({"faults": "freeze"}, "faults is 'freeze'"),
        ({"faults": {"kind": "freeze", "at_s": 1}}, "faults is"),
        ({"faults": ["freeze"]}, r"faults\[0\] is 'freeze'"),
        ({"faults": [{"kind": "melt", "at_s": 1}]}, r"faults\[0\] is .*melt"),
        ({"faults": [{"kind": "nan", "at_s": 1}, {"kind": "freeze"}]}, r"faults\[1\] is"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "segment": 1}]}, r"\(freeze\) is"),
        (
            {"faults": [{"kind": "freeze", "at_s": "soon"}]},
            r"mock option faults\[0\] \(freeze\)\.at_s is 'soon'",
        ),
        ({"faults": [{"kind": "freeze", "at_s": -1}]}, r"\.at_s is -1"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "by_s": 1}]}, r"\(freeze\) has no key by_s"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "after_s": 1}]}, r"after_s is 1"),
        ({"faults": [{"kind": "lag", "at_s": 1}]}, r"\(lag\) lacks by_s"),
        ({"faults": [{"kind": "drop", "at_s": 1, "samples": 0}]}, r"samples is 0"),
        ({"faults": [{"kind": "drop", "segment": 1.5}]}, r"segment is 1\.5"),
        ({"faults": [{"kind": "freeze", "at_s": float("nan")}]}, r"at_s is nan"),
    ],
)
def test_an_option_that_cannot_be_is_named(options, said):
    with pytest.raises(SpecError, match=said) as error:
        MockRobot("bench", **options)
    assert error.value.hint


def test_faults_are_read_as_they_stand_in_a_station():
    given = [
        {"kind": "protective_stop", "at_s": 2},
        {"kind": "lag", "segment": 3, "after_s": 0.5, "by_s": 0.2, "for_s": 1},
        {"kind": "clock_jump", "at_s": 1.0, "by_s": -3.0},
    ]
    stop, lag, jump = EmbeddedFault.all_of(given)
    assert (stop.kind, stop.at_s, stop.segment) == ("protective_stop", 2.0, None)
    assert (lag.segment, lag.after_s, lag.by_s, lag.for_s) == (3, 0.5, 0.2, 1.0)
    assert (jump.at_s, jump.by_s) == (1.0, -3.0)


def test_the_clock_is_virtual_unless_the_station_says_wall():
    assert MockRobot("bench").capabilities.clock == "virtual"
    assert MockRobot("bench", clock="wall").capabilities.clock == "wall"


def test_the_reference_has_a_row_for_every_option_and_every_kind_of_fault():
    rows = re.findall(r"^\| `(\w+)` \|", PAGE.read_text("utf-8"), re.MULTILINE)
    assert rows[: len(Options.__dataclass_fields__)] == list(Options.__dataclass_fields__)
    assert set(EmbeddedFault.kinds) <= set(rows)
