"""The UR driver's arithmetic: options, pacing, lag, braking, which row belongs to which segment."""

from __future__ import annotations

import socket
import struct
import threading

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, RobotConnectionError, RobotFault, SpecError, StaleState
from hil.robot import Segment, Status, state_dtype
from hil_drivers.arm import require_liftable
from hil_drivers.network import ip_address_of
from hil_drivers.ur.controller import KEPT_S, require_ready
from hil_drivers.ur.controller import DashboardFacts as Facts
from hil_drivers.ur.dashboard import Dashboard
from hil_drivers.ur.motion import PROGRESS
from hil_drivers.ur.options import (
    SERIES_HZ,
    capabilities_of,
    limits_of,
    options_of,
    require_playable,
)
from hil_drivers.ur.primary import limits_in
from hil_drivers.ur.robot import Standing, UrRobot, Watch
from hil_drivers.ur.servo import CATCH_UP, LagWatch, Ramp, SetPointFeed
from hil_drivers.ur.state import TOPIC, fault_of

TICK_S = 0.008


@pytest.mark.parametrize(
    ("options", "model", "said"),
    [
        ({}, "ur5", "needs the option address"),
        ({"address": "10.0.0.300"}, "ur5", "address is '10.0.0.300'"),
        ({"address": "10.0.0.3", "adress": 1}, "ur5", "no option adress"),
        ({"address": "10.0.0.3"}, "lab6", "cannot move a lab6"),
        ({"address": "10.0.0.3", "gain": 50}, "ur5", "gain is 50"),
        ({"address": "10.0.0.3", "gain": True}, "ur5", "gain is True"),
        ({"address": "10.0.0.3", "lookahead_s": "0.1"}, "ur5", "lookahead_s is '0.1'"),
        ({"address": "10.0.0.3", "moves": "movel"}, "ur5", "moves is 'movel'"),
        ({"address": "10.0.0.3", "frequency_hz": 100}, "ur5", "frequency_hz is 100"),
        ({"address": "10.0.0.3", "frequency_hz": 500}, "ur5", "frequency_hz is 500"),
        ({"address": "10.0.0.3", "torque_source": "current-as-torque"}, "ur5", "torque_source"),
    ],
)
def test_options_that_cannot_be_are_refused_with_what_would_be_right(options, model, said):
    with pytest.raises(SpecError, match=said) as caught:
        UrRobot("arm", model, **options)
    assert caught.value.hint


def test_a_slip_of_the_pen_is_told_with_what_was_meant():
    with pytest.raises(SpecError) as caught:
        UrRobot("arm", "ur5", adress="10.0.0.3")
    assert caught.value.hint.startswith("did you mean 'address'? its options are")


def test_one_arm_has_one_resource_however_its_address_is_written():
    written = [" UR5.Lab.Example ", "ur5.lab.example"]
    assert {UrRobot("a", "ur5", address=w).resource for w in written} == {"ur://ur5.lab.example"}
    assert UrRobot("a", "ur5", address="192.0.2.7").resource == "ur://192.0.2.7"


def test_rates_follow_the_series_and_the_share_of_the_speed_narrows_the_limits():
    options = options_of({"address": "192.0.2.7", "speed_share": 0.5}, "ur5")
    assert capabilities_of("ur5", options).rate_hz == 125
    assert capabilities_of("ur5e", options_of({"address": "a"}, "ur5e")).rate_hz == 500
    assert limits_of("ur5", options).qd_max == pytest.approx(np.full(6, np.pi / 2))


def test_torque_sources_say_what_effort_is():
    for source, kind, gains in (("current", "current", 6), ("target-moment", "torque", 0)):
        options = options_of({"address": "a", "torque_source": source}, "ur5")
        can = capabilities_of("ur5", options)
        assert (can.effort_kind, len(can.drive_gains)) == (kind, gains)


def ramp(rows=100):
    return np.outer(np.arange(rows, dtype=float), np.ones(6))


def test_a_set_point_per_tick_of_the_robot():
    feed = SetPointFeed(ramp(), 125.0, begun=10.0)
    told = [feed.due(10.0 + TICK_S * k)[0] for k in range(1, 100)]
    assert told == pytest.approx(range(1, 100))
    assert feed.over


def test_ticks_that_were_missed_are_caught_up_with_gently():
    feed = SetPointFeed(ramp(), 125.0, begun=0.0)
    feed.due(TICK_S)
    steps, last = [], 1.0
    for k in range(12, 70):  # ten ticks missed
        told = feed.due(TICK_S * k)[0]
        steps.append(told - last)
        last = told
    assert max(steps[:20]) <= CATCH_UP + 1e-9
    assert last == pytest.approx(69.0)
    assert feed.late_s == pytest.approx(0.0)


@pytest.mark.parametrize("every", [2, 3])
def test_a_host_that_answers_every_few_ticks_catches_up_too(every):
    feed = SetPointFeed(ramp(900), 500.0, begun=0.0)
    for k in range(every, 800, every):
        if 200 < k < 230:  # 60 ms in which nothing was answered
            continue
        last = feed.due(0.002 * k)[0]
        assert feed.late_s < 0.07
    assert feed.late_s == pytest.approx(0.0)
    assert last == pytest.approx(k)


def test_a_few_missed_ticks_are_made_up_for_at_once():
    feed = SetPointFeed(ramp(), 125.0, begun=0.0)
    feed.due(TICK_S)
    assert feed.due(TICK_S * 5)[0] == pytest.approx(5.0)
    assert feed.late_s == pytest.approx(0.0)


def test_late_set_points_say_how_late():
    feed = SetPointFeed(ramp(), 125.0, begun=0.0)
    feed.due(TICK_S * 51)
    assert feed.late_s == pytest.approx((51 - CATCH_UP) * TICK_S)


def test_a_clock_that_stands_still_commands_the_same_again():
    feed = SetPointFeed(ramp(), 125.0, begun=0.0)
    assert feed.due(TICK_S)[0] == feed.due(TICK_S)[0]


def test_lag_within_the_window_is_no_lag_at_any_speed():
    watch = LagWatch(lag_s=0.2, lag_rad=0.01)
    for k in range(100):
        watch.note(k * TICK_S, np.full(6, 3.0 * k * TICK_S))
        if k > 25:
            assert not watch.lost(np.full(6, 3.0 * (k - 25) * TICK_S))
    assert watch.lost(np.full(6, 3.0 * (99 - 30) * TICK_S))


def test_lag_says_which_joint_is_beside_the_path():
    watch = LagWatch(lag_s=0.2, lag_rad=0.01)
    watch.note(0.0, np.zeros(6))
    off = watch.off(np.array([0, 0, 0.3, 0, 0, 0]))
    assert (off.argmax(), off.max()) == (2, pytest.approx(0.3))


def rows_at(*times):
    rows = np.zeros(len(times), state_dtype(6))
    rows["device_time"] = times
    return rows


def stamped(standing, *times):
    rows = rows_at(*times)
    standing.stamp(rows)
    moving = (rows["status"] & Status.MOVING) != 0
    assert ((rows["status"] & Status.HOLDING != 0) == ~moving).all()
    return rows["segment"].tolist(), moving.tolist()


def test_rows_belong_to_the_segment_that_was_on_when_they_were_measured():
    standing = Standing()
    assert stamped(standing, 1.0, 2.0) == ([-1, -1], [False, False])
    standing.begin(7, 3.0, moves=True)
    assert stamped(standing, 2.5, 3.0, 3.1, 4.0) == ([-1, -1, 7, 7], [False, False, True, True])
    standing.end(5.0)
    standing.begin(8, 5.5, moves=False)
    assert stamped(standing, 4.5, 5.0, 5.1, 5.6) == ([7, 7, 7, 8], [True, True, False, False])


def test_a_motion_nobody_saw_end_ends_where_the_next_one_begins():
    standing = Standing()
    standing.begin(1, 1.0, moves=True)
    standing.begin(2, 2.0, moves=True)
    assert stamped(standing, 1.5, 2.5) == ([1, 2], [True, True])


LIMITS = limits_of("ur5", options_of({"address": "a"}, "ur5"))


def segment(q, qd=0.0, kind="move", speed=0.5, acceleration=1.0):
    q = np.array(q, dtype=float)
    return Segment(1, kind, q, np.full_like(q, qd), np.zeros_like(q), speed, acceleration)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (segment([[0.0] * 5]), "5 joints"),
        (segment([[0.0] * 5 + [np.nan]]), "not finite numbers"),
        (segment([[0.0] * 5 + [6.3]]), "joint range"),
        (segment([[0.1] * 6]), "begins 0.1000 rad from"),
        (segment([[0.0] * 6], qd=0.5), "begin and end at standstill"),
        (segment([[0.0] * 6], qd=4.0), "joint 1 with 4.000 rad/s"),
        (segment([[0.0] * 6], speed=3.5), "3.500 rad/s"),
        (segment([[0.0] * 6], acceleration=50.0), "50.0 rad/s²"),
    ],
)
def test_segments_that_cannot_be_are_refused_before_anything_moves(asked, said):
    with pytest.raises(CommandRefused, match=said):
        require_playable(asked, LIMITS, np.zeros(6))


def test_a_load_that_is_too_heavy_is_refused():
    require_liftable(Payload(5.0), LIMITS)
    with pytest.raises(CommandRefused, match="too heavy"):
        require_liftable(Payload(5.1), LIMITS)


RAW = np.dtype(
    [
        ("timestamp", "<f8"),
        ("safety_mode", "<i4"),
        ("robot_mode", "<i4"),
        ("runtime_state", "<u4"),
        ("target_speed_fraction", "<f8"),
        ("target_qd", "<f8", (6,)),
    ]
)
RAW_OF_STATE = np.dtype(
    [*((name, RAW[name]) for name in RAW.names), ("host_time", "<f8"),
     *((name, "<f8", (6,)) for name in ("target_q", "actual_q", "actual_qd"))]
)  # fmt: skip


def raw(safety=1, mode=7, runtime=2, share=1.0, speed=0.0):
    return np.array([(12.0, safety, mode, runtime, share, [speed] * 6)], RAW)[0]


def test_an_arm_that_obeys_has_no_fault():
    assert fault_of(raw(), program=True) is None
    assert fault_of(raw(runtime=1), program=False) is None


@pytest.mark.parametrize(
    ("row", "said", "remedy"),
    [
        (raw(safety=3, runtime=4), "a protective stop at device time 12.000 s", "unlock it"),
        (raw(safety=7, mode=3), "an emergency stop; the arm is switched off", "release the button"),
        (raw(mode=5), "brakes are on", "release the brakes"),
        (raw(runtime=1), "program is stopped", "connect again"),
        (raw(safety=77), "safety mode 77", "teach pendant"),
    ],
)
def test_faults_are_told_with_the_remedy(row, said, remedy):
    fault = fault_of(row, program=True)
    assert said in fault.message
    assert remedy in fault.hint


def test_what_to_do_is_said_once():
    for safety in (6, 7):
        hint = fault_of(raw(safety=safety, mode=3), program=True).hint
        assert hint.count("switch the arm on") == 1
        assert hint.count("brakes") == 1
        with pytest.raises(RobotFault) as caught:
            require_ready("10.0.0.3", "ur5", Facts(), (3, 15, 8, 0), raw(safety, 3))
        assert caught.value.hint.count("brakes") == 1


@pytest.mark.parametrize("safety", [3, 5, 12])
def test_a_driver_does_not_know_whether_there_is_a_run_to_resume(safety):
    hint = fault_of(raw(safety=safety), program=True).hint
    assert hint.endswith("then connect again")
    assert "resume" not in hint


CB3, E = (3, 15, 8, 0), (5, 12, 2, 0)


@pytest.mark.parametrize(
    ("model", "told", "version", "row", "kind", "said"),
    [
        ("ur5e", Facts(), CB3, raw(), RobotConnectionError, "CB3 controller"),
        ("ur5", Facts(model="UR10"), CB3, raw(), RobotConnectionError, "moves a UR10"),
        (
            "ur5",
            Facts(),
            (3, 9, 0, 0),
            raw(),
            RobotConnectionError,
            "does not report the payload",
        ),
        ("ur5e", Facts(), (10, 1, 0, 0), raw(), RobotConnectionError, "not supported"),
        ("ur5e", Facts(remote="false"), E, raw(), RobotFault, "local control"),
        (
            "ur5",
            Facts(),
            CB3,
            raw(runtime=1, share=0.5),
            RobotFault,
            "speed slider is at 50%",
        ),
        ("ur5", Facts(), CB3, raw(safety=3, runtime=1), RobotFault, "protective stop"),
        ("ur5", Facts(), CB3, raw(runtime=2), RobotFault, "a program is running"),
        ("ur5", Facts(), CB3, raw(runtime=5), RobotFault, "a program is running"),
        ("ur5", Facts(), CB3, raw(runtime=3), RobotFault, "a program is paused"),
        ("ur5", Facts(), CB3, raw(runtime=4), RobotFault, "a program is paused"),
        ("ur5", Facts(), CB3, raw(runtime=0), RobotFault, "about to end"),
        (
            "ur5",
            Facts(),
            CB3,
            raw(runtime=1, speed=0.1),
            RobotFault,
            "moving at 0.100 rad/s",
        ),
    ],
)
def test_an_arm_that_may_not_be_moved_is_refused(model, told, version, row, kind, said):
    with pytest.raises(kind, match=said) as caught:
        require_ready("192.0.2.7", model, told, version, row)
    assert caught.value.hint


def test_all_reasons_are_told_at_once():
    with pytest.raises(RobotFault) as caught:
        require_ready("a", "ur5e", Facts(remote="false"), E, raw(safety=3, runtime=4, share=0.1))
    reasons = ("protective", "slider", "local", "paused")
    assert all(word in caught.value.message for word in reasons)


def test_an_arm_that_may_be_moved_is_not_refused():
    require_ready("a", "ur5e", Facts(model="UR5", remote="true"), E, raw(runtime=1))
    require_ready("a", "ur5", Facts(), CB3, raw(safety=2, runtime=1))


def block(*rows):
    """Raw rows a tick apart, from device time 10 s on."""
    rows = np.array([row.item() for row in rows], RAW)
    rows["timestamp"] = 10.0 + TICK_S * np.arange(len(rows))
    return rows


def watch(**options):
    return Watch(options_of({"address": "192.0.2.7"} | options, "ur5"))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (raw(safety=3, runtime=4), "a protective stop at device time 10.008 s"),
        (raw(runtime=1), "program is stopped at device time 10.008 s"),
        (raw(mode=5), "brakes are on"),
    ],
)
def test_a_fault_that_is_over_at_the_end_of_a_block_is_a_fault(wrong, said):
    standing = watch()
    standing.look(block(raw(), wrong, raw()), None, None)
    assert standing.faulty
    assert said in standing.problem.message


def test_what_has_stopped_the_program_is_told_before_that_it_has_stopped():
    standing = watch()
    standing.look(block(raw(), raw(runtime=1), raw(safety=7, runtime=1)), None, None)
    assert "an emergency stop" in standing.problem.message


def test_a_program_that_we_have_replaced_is_not_missed():
    standing = watch()
    standing.replaced = True
    standing.look(block(raw(runtime=1), raw(runtime=1)), None, None)
    assert not standing.faulty


def test_a_stop_has_failed_when_the_arm_moves_as_it_ought_to_stand_and_not_when_it_does_later():
    stopped = block(*[raw(speed=0.6)] * 10, *[raw()] * 100, *[raw(speed=0.4)] * 20)
    for deaf in (False, True):
        standing = watch()
        standing.stopping(stopped[0])
        rows = stopped.copy()
        rows["target_qd"][10:110] = 0.6 * deaf
        assert standing.stop_has_failed(rows) == deaf
        assert not standing.stop_has_failed(rows)


def test_only_our_own_program_is_kept_from_going_on():
    held, idle = raw(safety=3, runtime=4), raw(runtime=1)
    paused = watch()
    paused.look(block(raw(), held), None, None)
    assert paused.must_not_go_on(held)
    ended = watch()
    ended.look(block(raw(), idle), None, None)
    ended.look(block(raw(runtime=2), raw(runtime=2)), None, None)
    assert not ended.must_not_go_on(raw(runtime=4))
    assert not watch().must_not_go_on(raw(runtime=4)), "there is no fault"


@pytest.mark.parametrize(
    ("then", "said"), [(raw(runtime=1), "program is stopped"), (raw(), "it has died")]
)
def test_that_the_process_next_door_has_left_waits_for_the_row_that_explains_it(then, said):
    standing, died = watch(), RobotConnectionError("it has died")
    rows = block(*[raw()] * 40, *[then] * 40)
    standing.look(rows[:1], None, died, left=True)
    standing.look(rows[:40], None, RobotConnectionError("nobody is there"), left=True)
    assert not standing.faulty
    standing.look(rows[40:], None, RobotConnectionError("nobody is there"), left=True)
    assert said in standing.problem.message


def test_silence_that_stopped_the_arm_is_not_hidden_by_the_stop_it_has_led_to():
    """The stop has ended the program, which nobody has done at the teach pendant."""
    quiet = StaleState("nothing was said for 0.12 s")
    rows = block(*[raw()] * 20, *[raw(runtime=1)] * 80)
    standing = watch()
    standing.look(rows[:30], None, quiet, left=True)
    standing.look(rows[30:], None, RobotConnectionError("nobody is there"), left=True)
    assert standing.problem is quiet
    stopped = watch()
    stopped.look(rows[:30], None, quiet, left=True)
    stopped.look(block(raw(safety=3, runtime=4)), None, quiet, left=True)
    assert "protective stop" in stopped.problem.message


def test_that_it_has_died_is_told_at_once():
    standing = watch()
    standing.look(block(raw()), None, RobotConnectionError("it has died"))
    assert "it has died" in standing.problem.message


def progress(status):
    told = np.zeros(1, PROGRESS)
    told["device_time"], told["status"] = 10.0, int(status)
    return told[0]


def test_a_stop_is_not_over_before_the_process_that_makes_it_says_so():
    standing = watch()
    standing.begun(1, 9.0, moves=True)
    standing.stopping(raw())
    for told, moving in ((Status.MOVING, True), (Status.HOLDING, False)):
        standing.look(block(raw()), progress(told), None)
        assert standing.moving == moving


def test_without_that_process_it_is_over_when_the_arm_stands():
    standing = watch()
    standing.begun(1, 9.0, moves=True)
    standing.stopping(raw())
    standing.look(block(raw()), None, None)
    assert not standing.moving


def test_what_plays_seconds_after_our_program_has_ended_is_for_others():
    standing = watch()
    rows = block(raw(), *[raw(runtime=1)] * 300, *[raw(runtime=2)] * 300)
    standing.look(rows[:100], None, None)
    assert standing.gone_at == rows["timestamp"][1]
    assert [standing.is_for_others(rows[at]) for at in (100, 300, 400, 600)] == [
        False, False, True, True
    ]  # fmt: skip
    assert not watch().is_for_others(rows[-1])


class Taken:
    """In place of a receiver: one block of rows, and what is asked of it."""

    alive = True

    def __init__(self, rows):
        self.rows, self.newest, self.kept = rows, rows[-1:], []

    def take(self, timeout_s):
        return self.rows

    def keep(self, seconds, *, forgiving=False):
        self.kept.append((seconds, forgiving))


class Deaf:
    """In place of the process that moves the arm: it has died."""

    alive = left = False

    def look(self):
        raise RobotConnectionError("it has died")

    stop = close = look


def connected_to(rows, monkeypatch):
    robot = UrRobot("arm", "ur5", address="192.0.2.7")
    robot._controller.receiver, robot._motion, robot._connected = Taken(rows), Deaf(), True
    monkeypatch.setattr("hil_drivers.ur.robot.stop_directly", lambda *args: False)
    monkeypatch.setattr("hil_drivers.ur.robot.stop_program", lambda *args: False)
    return robot


def raw_rows(count, speed=0.0):
    rows = np.zeros(count, RAW_OF_STATE)
    rows["timestamp"] = 10.0 + TICK_S * np.arange(count)
    rows["target_qd"], rows["robot_mode"], rows["safety_mode"] = speed, 7, 1
    rows["runtime_state"] = 2
    return rows


def test_rows_that_were_taken_are_given_whatever_goes_wrong_then(monkeypatch):
    rows = raw_rows(500, speed=0.5)
    robot = connected_to(rows, monkeypatch)
    robot._watch.stopping(rows[0])
    assert len(robot.read()) == 500
    assert len(robot.drain()[TOPIC]) == 500
    with pytest.raises(RobotConnectionError, match="it has died"):
        robot.read()


def test_all_of_a_dwell_is_kept_and_little_of_what_an_arm_does_that_was_stopped(monkeypatch):
    robot = connected_to(raw_rows(5), monkeypatch)
    robot._motion.look = lambda: np.zeros(1, PROGRESS)
    receiver = robot._controller.receiver
    robot.prepare(segment([[0.0] * 6], kind="hold"))
    robot.start()
    robot.read()
    assert receiver.kept[-1] == (None, False)
    robot._motion.stop = lambda: None
    robot.stop()
    robot.read()
    assert receiver.kept[-1] == (KEPT_S, False)
    robot.prepare(segment([[0.0] * 6], kind="hold"))
    robot.start()
    robot.read()
    assert receiver.kept[-1] == (None, False)


def test_rows_from_before_a_hold_was_started_are_not_its_own(monkeypatch):
    """They may be seconds old, and from when the arm was braking."""
    rows = raw_rows(500)
    robot = connected_to(rows, monkeypatch)
    robot._motion.look = lambda: np.zeros(1, PROGRESS)
    robot._controller.receiver.newest = rows[400:401]
    robot.prepare(segment([[0.0] * 6], kind="hold"))
    robot.start()
    assert int((robot.read()["segment"] >= 0).sum()) == 99


def test_after_a_motion_nobody_has_to_read_for_ever(monkeypatch):
    robot = connected_to(raw_rows(5), monkeypatch)
    robot._motion.look = lambda: np.zeros(1, PROGRESS)
    robot._watch.begun(1, 9.0, moves=True)
    robot.read()
    assert robot._controller.receiver.kept == [(None, True)]


def configured(q=(-3.0, 3.0), most=(2.0, 10.0)):
    numbers = struct.pack(">24d", *(q * 6), *(most * 6)) + bytes(253)
    return struct.pack(">IB", 5 + len(numbers), 6) + numbers


def test_joint_limits_are_read_wherever_they_stand_in_a_robot_state():
    other = struct.pack(">IB", 9, 3) + bytes(4)
    told = limits_in(other + configured() + other)
    assert told.q_min.tolist() == [-3.0] * 6
    assert told.q_max.tolist() == [3.0] * 6
    assert told.qd_max.tolist() == [2.0] * 6
    assert told.qdd_max.tolist() == [10.0] * 6
    assert limits_in(other) is None


def test_of_maker_and_controller_the_stricter_one_counts_joint_by_joint():
    told = limits_in(configured(q=(-3.0, 9.0), most=(2.0, 1000.0)))
    used = told.narrow(LIMITS)
    assert used.q_min.tolist() == [-3.0] * 6
    assert (used.q_max == LIMITS.q_max).all()
    assert used.qd_max.tolist() == [2.0] * 6
    assert (used.qdd_max == LIMITS.qdd_max).all()
    assert used.payload_max_kg == LIMITS.payload_max_kg


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (b"\0\0\0", "truncated"),
        (struct.pack(">IB", 99, 3), "99 bytes"),
        (struct.pack(">IB", 0, 3) + bytes(20), "0 bytes"),
        (struct.pack(">IB", 9, 6) + bytes(4), "only 4 bytes"),
        (configured(q=(3.0, -3.0)), "impossible joint limits"),
        (configured(most=(float("nan"), 1.0)), "impossible joint limits"),
        (configured(most=(2.0, 0.0)), "impossible joint limits"),
    ],
)
def test_limits_that_cannot_be_are_none(state, said):
    with pytest.raises(ValueError, match=said):
        limits_in(state)


def test_a_name_is_looked_up_once_and_not_for_longer_than_it_may_take(monkeypatch):
    assert ip_address_of("192.0.2.7") == "192.0.2.7"
    assert ip_address_of("localhost") == "127.0.0.1"
    asked, waited_out = threading.Event(), list[bool]()

    def hangs(*args):
        waited_out.append(asked.wait(300.0))
        raise socket.gaierror(-3, "Temporary failure in name resolution")

    monkeypatch.setattr("socket.getaddrinfo", hangs)
    with pytest.raises(RobotConnectionError, match=r"no answer within 0\.1 s"):
        ip_address_of("ur5.lab.example", 0.1)
    assert not waited_out
    asked.set()


def test_a_name_that_nobody_knows_is_told_with_what_to_do(monkeypatch):
    def unknown(*args):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr("socket.getaddrinfo", unknown)
    with pytest.raises(
        RobotConnectionError, match=r"'ur5\.lab\.example' cannot be resolved: Name"
    ) as caught:
        ip_address_of("ur5.lab.example")
    assert "cannot be resolved: Name or service not known" in caught.value.message
    assert "IP address" in caught.value.hint


@pytest.mark.parametrize(
    ("address", "begins"),
    [
        ("127.0.0.9", "start the mock first: hil mock ur; if "),
        ("192.0.2.7", "check that the controller is on"),
    ],
)
def test_where_nothing_answers_on_loopback_a_mock_is_to_be_started(address, begins, monkeypatch):
    def refused(*args):
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr("socket.create_connection", refused)
    with pytest.raises(RobotConnectionError) as caught:
        Dashboard(address)
    assert caught.value.hint.startswith(begins)


# Stops of a UR arm: hard enough to be over before its watchdog bites, and seen to be obeyed.


ROW = np.dtype([("timestamp", "f8"), ("target_qd", "f8", 6), ("target_TCP_speed", "f8", 6)])


def row(at, fastest, tool=0.0):
    made = np.zeros(1, ROW)
    made[0] = (at, [0, 0, 0, 0, 0, fastest], [0, 0, 0, 0, 0, tool])
    return made[0]


def options(**given):
    return options_of({"address": "192.0.2.7"} | given, "ur5")


@pytest.mark.parametrize("model", SERIES_HZ)
def test_with_the_usual_options_a_stop_out_of_full_speed_is_over_in_time(model):
    usual = options_of({"address": "192.0.2.7"}, model)
    assert 1.0 / usual.watchdog_hz <= 0.5


@pytest.mark.parametrize(
    "given", [{"watchdog_hz": 4.0}, {"stop_rad_s2": 6.0}, {"watchdog_hz": 20.0, "speed_share": 0.1}]
)
def test_a_watchdog_that_would_bite_during_a_stop_is_refused_with_what_would_do(given):
    with pytest.raises(SpecError, match="watchdog_hz") as caught:
        options(**given)
    assert "stop_rad_s2" in caught.value.hint


def test_slower_arms_and_harder_stops_may_have_a_faster_watchdog():
    assert options(watchdog_hz=4.0, speed_share=0.3).watchdog_hz == 4.0
    assert options(watchdog_hz=4.0, stop_rad_s2=30.0).watchdog_hz == 4.0


def test_an_arm_that_is_led_fast_is_stopped_harder_than_it_might_be():
    usual = options()
    assert Ramp(row(0.0, 1.0, 2.0), usual, led=True).deceleration == usual.stop_m_s2
    fast = Ramp(row(0.0, 3.0, 8.0), usual, led=True)
    assert 8.0 / fast.deceleration == pytest.approx(1.0 / usual.watchdog_hz - 0.1)
    assert Ramp(row(0.0, 3.0, 8.0), usual, led=False).deceleration == usual.stop_rad_s2


def test_an_arm_obeys_when_its_commanded_speed_falls_also_out_of_a_start():
    ramp = Ramp(row(0.0, 1.0), options(), led=False)
    assert [ramp.falls(row(0.0, speed)) for speed in (1.0, 1.2, 1.4, 1.4, 1.33)] == [
        False, False, False, False, True
    ]  # fmt: skip


def test_an_arm_that_has_not_begun_to_move_does_not_stand_before_the_stop_was_made():
    ramp = Ramp(row(0.0, 0.0), options(), led=False)
    assert not ramp.stands(row(0.0, 0.0))
    ramp.answered = True
    assert ramp.stands(row(0.0, 0.0))


def test_a_ramp_that_takes_too_long_is_told_once():
    ramp = Ramp(row(1.0, 0.8), options(), led=False)
    assert not ramp.overdue(row(1.3, 0.5))
    assert ramp.overdue(row(1.5, 0.5))
    assert not ramp.overdue(row(2.0, 0.5))


def test_a_stop_that_comes_while_a_segment_is_prepared_holds(monkeypatch):
    robot = UrRobot("arm", "ur5", address="192.0.2.7")
    zeros = np.zeros((1, 6))
    at = np.zeros(1, [("timestamp", "f8"), ("target_q", "f8", 6), ("target_qd", "f8", 6)])

    class Next:
        alive = True

        def prepare(self, segment):
            robot.stop()

        def stop(self):
            pass

        def close(self):
            pass

    monkeypatch.setattr(robot, "_motion", Next())
    monkeypatch.setattr(robot, "_connected", True)
    monkeypatch.setattr(type(robot._controller), "row", at[0])
    with pytest.raises(CommandRefused, match="stopped while"):
        robot.prepare(Segment(1, "move", zeros, zeros, zeros, 0.0, 0.0))
    with pytest.raises(CommandRefused, match="no segment"):
        robot.start()
