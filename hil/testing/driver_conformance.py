"""Does a driver keep the contract of `hil.robot.Robot`? One function asks it, for any driver.

>>> from hil.testing import robot_conformance
>>> robot_conformance(lambda: MyArm("bench", "ur5", address="192.0.2.7"))     # doctest: +SKIP

Each check is a function of a robot whose name is the sentence that it checks; it raises
`AssertionError` with what the robot did instead. The checks stand in groups, and each group ends
with the tuple that `robot_conformance` goes through: before connecting, connected and at rest,
limits, stops, faults. Checks that cannot do with the robot alone take a `Bench`, which says how
fast the robot slows down, who sees its wire and who can make it fault.

A failure is noted and the next check begins, with a new robot: a driver's author gets all failures
at once. Nothing here needs pytest; `RobotConformance` makes a test of each check.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from hil.arms import Payload
from hil.core import (
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotError,
    RobotFault,
    RobotTimeout,
)
from hil.robot import HasResource, Robot, Segment, Status, state_dtype
from hil.testing.moves import (
    AT_SET_POINT_RAD,
    LONG_WAY_RAD,
    REST_RAD_S,
    begin,
    follow,
    hold,
    line,
    move,
    rest_time,
    room,
    rows_for,
    settle,
    standing_at,
)

MakeRobot: TypeAlias = Callable[[], Robot]
Check: TypeAlias = Callable[[Robot], None]
BenchCheck: TypeAlias = Callable[[Robot, "Bench"], None]

KINDS: tuple[Literal["move", "trajectory"], ...] = ("move", "trajectory")

STOP_S = 0.1
"""Wall time that `stop` may take, and the command until it is with the controller [s]."""
FAULT_S = 1.0
"""How soon a fault has to be told, by the clock of `Capabilities.clock` [s]."""
SEEN_WITHIN_S = 1.0
"""How long a witness may take to say what it saw [s]."""


@dataclass(frozen=True, slots=True)
class Bench:
    """Where a driver is tested.

    Attributes:
        move_ramp_rad_s2: Deceleration of the last joint when a move is stopped [rad/s²].
        trajectory_ramp_rad_s2: The same when a trajectory is stopped.
        stop_seen: Given a moment of `time.monotonic`, when the first stop after it came to the
            controller, by the same clock; None while there is none. A mock's journal can tell, or
            a listener on the wire.
        fault: Makes the robot, which moves, fault: by a mock's side channel, or a person who
            presses the button when asked.
    """

    move_ramp_rad_s2: float = 2.0
    trajectory_ramp_rad_s2: float = 2.0
    stop_seen: Callable[[float], float | None] | None = None
    fault: Callable[[Robot], object] | None = None


class NotConforming(AssertionError):
    """A driver breaks the contract; the message lists every check that found so.

    Attributes:
        failures: Name of the check → what it found.
    """

    def __init__(self, failures: dict[str, str]) -> None:
        super().__init__("".join(f"\n{name}: {found}" for name, found in failures.items()))
        self.failures = failures


def robot_conformance(
    make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
) -> tuple[str, ...]:
    """Check a driver against the robot protocol, moving its last joint by up to 0.4 rad at a time.

    Args:
        make_robot: Gives a robot that is not connected, a fresh one each time. It is connected,
            moved, stopped and closed; a real one needs room around it.
        leave_out: Checks that are not done.
        bench: What there is beside the robot. What no bench can see or do is not checked.

    Returns:
        Names of the checks that were done.

    Raises:
        NotConforming: At least one of them failed.
    """
    bench = bench or Bench()
    alone = _kept(BEFORE_AND_AFTER, leave_out)
    together = _kept(
        (*CONNECTED, *_at(bench, (*BENCH, *(SEEN if bench.stop_seen else ())))), leave_out
    )
    faulty = _kept(_at(bench, FAULTY if bench.fault else ()), leave_out)
    failures = dict(_alone(make_robot, alone))
    failures |= dict(_together(make_robot, together))
    failures |= dict(_alone(make_robot, faulty))
    if failures:
        raise NotConforming(failures)
    return tuple(check.__name__ for check in (*alone, *together, *faulty))


class Conformance(Protocol):
    """What the fixture `robot_conformance` gives: the function above."""

    def __call__(
        self, make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
    ) -> tuple[str, ...]:
        """See `robot_conformance`."""


def check_names() -> tuple[str, ...]:
    """Names of all checks, in the order in which they are done."""
    checks = (*BEFORE_AND_AFTER, *CONNECTED, *BENCH, *SEEN, *FAULTY)
    return tuple(dict.fromkeys(check.__name__ for check in checks))


def _kept(checks: Sequence[Check], leave_out: Sequence[str]) -> list[Check]:
    return [check for check in checks if check.__name__ not in leave_out]


def _at(bench: Bench, checks: Sequence[BenchCheck]) -> list[Check]:
    """The checks with their bench, under their own names."""

    def bound(check: BenchCheck) -> Check:
        @functools.wraps(check)
        def at_the_bench(robot: Robot) -> None:
            check(robot, bench)

        return at_the_bench

    return [bound(check) for check in checks]


def _alone(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """Each on a robot of its own, not connected."""
    for check in checks:
        with _closing(make_robot()) as robot:
            yield from _done(check, robot)


def _together(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """One after the other on one connected robot, a new one after every failure."""
    left = list(checks)
    while left:
        with _closing(make_robot()) as robot:
            robot.connect()
            failed = False
            while left and not failed:
                for failure in _done(left.pop(0), robot):
                    failed = True
                    yield failure


def _done(check: Check, robot: Robot) -> Iterator[tuple[str, str]]:
    try:
        check(robot)
    except AssertionError as error:
        yield check.__name__, str(error)
    except Exception as error:  # a driver may fail in any way it likes
        told = error.message if isinstance(error, HilError) else str(error)
        yield check.__name__, f"raised {type(error).__name__}: {told}"


@contextlib.contextmanager
def _closing(robot: Robot) -> Iterator[Robot]:
    """However a check ended, the arm comes to rest before the next one gets a robot."""
    try:
        yield robot
    finally:
        for step in (robot.stop, lambda: settle(robot), robot.close):
            with contextlib.suppress(Exception):
                step()


# What several checks assert.


def raises(kind: type[HilError], call: Callable[[], object], what: str) -> None:
    """A call has to raise an error of this kind.

    Raises:
        AssertionError: It raises another one, or none.
    """
    try:
        call()
    except kind:
        return
    except Exception as error:
        raise AssertionError(
            f"{what} raised {type(error).__name__}, not {kind.__name__}"
        ) from error
    raise AssertionError(f"{what} did not raise {kind.__name__}")


def stop_in_time(robot: Robot, when: str) -> None:
    """Call `stop`.

    Raises:
        AssertionError: It takes too long.
    """
    asked = time.perf_counter()
    robot.stop()
    took = time.perf_counter() - asked
    assert took < STOP_S, f"stop {when} took {took * 1e3:.0f} ms"


# Before connecting, and after closing.


def names_rates_and_limits_are_known_before_connecting(robot: Robot) -> None:
    """`capabilities` and `limits` belong together and make sense."""
    can, limits = robot.capabilities, robot.limits
    n = len(can.joint_names)
    assert n > 0, "no joints"
    assert can.rate_hz > 0, f"a rate of {can.rate_hz} Hz"
    assert can.effort_kind in ("current", "torque"), f"efforts in {can.effort_kind}"
    assert can.clock in ("wall", "virtual"), f"a clock that is {can.clock}"
    for name in ("q_min", "q_max", "qd_max", "qdd_max", "effort_max"):
        shape = np.shape(getattr(limits, name))
        assert shape == (n,), f"limits.{name} has shape {shape}, not ({n},)"
    assert (limits.q_min < limits.q_max).all(), "limits.q_min is not below q_max"


def every_joint_has_limits_and_gains(robot: Robot) -> None:
    """Numbers above 0, as what watches over a run compares with them; gains may be unknown.

    A driver that cannot know a limit leaves this out, and its documentation says which.
    """
    can, limits = robot.capabilities, robot.limits
    for name in ("qd_max", "qdd_max", "effort_max"):
        known = np.isfinite(getattr(limits, name)) & (getattr(limits, name) > 0)
        lacking = [can.joint_names[i] for i in np.flatnonzero(~known)]
        assert not lacking, f"limits.{name} says nothing of {', '.join(lacking)}"
    gains = np.array(can.drive_gains)
    assert len(gains) in (0, len(can.joint_names)), (
        f"{len(gains)} drive gains for {len(can.joint_names)} joints"
    )
    assert (np.isfinite(gains) & (gains != 0)).all(), f"drive gains {can.drive_gains}"


def a_robot_in_wall_time_says_which_one_it_is(robot: Robot) -> None:
    """`resource` is known, and the same from every station file; else two may drive one arm.

    A simulation that is private to its process leaves this out.
    """
    if robot.capabilities.clock == "virtual":
        return
    assert isinstance(robot, HasResource), "it has no `resource`, such as its address"
    said = robot.resource
    assert isinstance(said, str), f"its `resource` is {said!r}, no text"
    assert said.strip(), "its `resource` is empty"


def nobody_is_there_before_connecting(robot: Robot) -> None:
    """`identity` and `read` raise `RobotConnectionError`."""
    raises(RobotConnectionError, lambda: robot.identity, "identity before connect")
    raises(RobotConnectionError, robot.read, "read before connect")


def stop_works_before_connecting(robot: Robot) -> None:
    """There is nothing to stop, and it says nothing."""
    stop_in_time(robot, "before connect")


def connecting_twice_is_connecting_once(robot: Robot) -> None:
    """`connect` is idempotent."""
    robot.connect()
    before = robot.identity
    robot.connect()
    assert robot.identity == before, f"connected again it is {robot.identity}, not {before}"
    robot.read()


def a_closed_robot_is_gone(robot: Robot) -> None:
    """`close` and `stop` are idempotent; `read` says that nobody is there."""
    robot.connect()
    robot.read()
    robot.close()
    robot.close()
    stop_in_time(robot, "after close")
    raises(RobotConnectionError, robot.read, "read after close")


BEFORE_AND_AFTER: tuple[Check, ...] = (
    names_rates_and_limits_are_known_before_connecting,
    every_joint_has_limits_and_gains,
    a_robot_in_wall_time_says_which_one_it_is,
    nobody_is_there_before_connecting,
    stop_works_before_connecting,
    connecting_twice_is_connecting_once,
    a_closed_robot_is_gone,
)
"""Each needs a robot that is not connected."""


# Connected: rows, moves and the payload.


def rows_are_state_rows_in_order(robot: Robot) -> None:
    """`read` gives at least one row of `state_dtype(n)`; device time increases row by row."""
    blocks = [robot.read() for _ in range(5)]
    expected = state_dtype(len(robot.capabilities.joint_names))
    for block in blocks:
        assert len(block), "a block without rows"
        assert block.dtype == expected, f"rows are {block.dtype}, not {expected}"
    times = np.concatenate(blocks)["device_time"]
    assert np.isfinite(times).all(), "a device time that is not a number"
    assert (np.diff(times) > 0).all(), "device times repeat or run backwards"


def a_robot_at_rest_holds(robot: Robot) -> None:
    """Nobody moved it: no `MOVING`, no speed, no fault."""
    row = robot.read()[-1]
    assert not row["status"] & (Status.MOVING | Status.FAULT), f"status {row['status']} at rest"
    assert np.abs(row["qd"]).max() < REST_RAD_S, f"moves at {row['qd']} rad/s"


def what_was_not_prepared_does_not_start(robot: Robot) -> None:
    """`start` raises a `RobotError`, also when a segment was started before."""
    raises(RobotError, robot.start, "start with nothing prepared")


_AT_GOAL_RAD = 0.01


def a_move_ends_where_it_was_told(robot: Robot) -> None:
    """Its rows carry its segment, `MOVING` ends at the goal."""
    segment = move(robot, 0.1)
    mine = follow(robot, segment)
    off = np.abs(mine[-1]["q"] - segment.q[-1]).max()
    assert off < _AT_GOAL_RAD, f"ended {off:.4f} rad from where it was told to"
    assert (np.diff(mine["device_time"]) > 0).all(), "device times repeat or run backwards"


def a_hold_of_one_set_point_holds(robot: Robot) -> None:
    """N = 1: the rows carry the segment, and nothing moves."""
    here = standing_at(robot)
    mine = follow(robot, hold(robot))
    off = np.abs(mine[-1]["q"] - here).max()
    assert off < _AT_GOAL_RAD, f"a hold has moved by {off:.4f} rad"


def the_payload_is_read_back(robot: Robot) -> None:
    """`set_payload` returns what the controller has, and nothing again after that."""
    mass = min(1.0, robot.limits.payload_max_kg / 2)
    declared = Payload(mass, (0.0, 0.01, 0.04))
    for payload in (declared, Payload()):
        told = robot.set_payload(payload)
        assert payload.agrees_with(told), f"declared {payload}, read back {told}"


def a_read_waits_no_longer_than_it_may(robot: Robot) -> None:
    """A tiny time-out gives rows or `RobotTimeout`, and the next read gives rows."""
    asked = time.monotonic()
    with contextlib.suppress(RobotTimeout):
        robot.read(1e-4)
    took = time.monotonic() - asked
    assert took < 2.0, f"read(timeout_s=1e-4) took {took:.2f} s"
    assert len(robot.read()), "a block without rows"


OUTSIDE_RAD = 0.1
BESIDE_RAD = 0.02
"""How far the integral of the velocity may be from the position: a lag of 60 ms [rad]."""
RATE_SHARE = 0.01
CLOCKS_S = 10.0
EFFORT_SHARE = 1.2
COLDEST_C, HOTTEST_C = -20.0, 120.0


def rows_are_in_the_units_they_say(robot: Robot) -> None:
    """Rad, rad/s, s, °C, Unix time, and A or N·m, as far as rows of a slow move can tell."""
    can, limits = robot.capabilities, robot.limits
    rows = follow(robot, move(robot, LONG_WAY_RAD))
    t, q, qd = rows["device_time"], rows["q"], rows["qd"]

    outside = np.maximum(limits.q_min - q, q - limits.q_max).max()
    assert outside < OUTSIDE_RAD, f"q is {outside:.2f} outside the joint range: is it in rad?"

    steps = (qd[1:] + qd[:-1]) / 2 * np.diff(t)[:, None]
    beside = np.abs(np.cumsum(steps, axis=0) - (q[1:] - q[0])).max()
    assert beside < BESIDE_RAD, (
        f"qd summed up over device time ends {beside:.3f} rad beside q: is qd in rad/s and device "
        "time in s?"
    )

    measured = 1.0 / float(np.median(np.diff(t)))
    assert abs(measured - can.rate_hz) < RATE_SHARE * can.rate_hz, (
        f"measured rate {measured:.4g} Hz (device time), capabilities state {can.rate_hz:g} Hz"
    )
    if can.clock == "wall":
        off = abs(float(rows["host_time"][-1]) - time.time())
        assert off < CLOCKS_S, f"host_time is {off:.1f} s off Unix time"

    # A current can be compared with a limit in N·m only where the drive gains are known.
    if can.effort_kind == "torque" or can.drive_gains:
        gains = np.abs(can.drive_gains) if can.effort_kind == "current" else 1.0
        torque: FloatArray = np.abs(rows["effort"]) * gains
        # An effort that is NaN was not measured, and does not count as too much.
        too_much = (torque > EFFORT_SHARE * limits.effort_max).any(axis=0)
        named = [can.joint_names[i] for i in np.flatnonzero(too_much)]
        assert not named, (
            f"effort of {', '.join(named)} is beyond effort_max in a slow move: is it the "
            f"{can.effort_kind} that capabilities say?"
        )

    known = rows["temperature"][np.isfinite(rows["temperature"])]
    plausible = (known > COLDEST_C) & (known < HOTTEST_C)
    assert plausible.all(), f"a temperature of {known[~plausible][0]:g}: is it in °C?"


# Limits: what a robot cannot do is refused before anything moves.

TOO_FAR_RAD = 0.2
TOO_MUCH = 1.5
"""Share of a limit that is asked for."""
_RUN_UP = 2.2
"""Way that getting fast and slow again takes, in velocities squared per acceleration."""
WATCHED_S = 0.2


def a_position_beyond_the_limits_is_refused(robot: Robot) -> None:
    """`prepare` raises for a segment that leaves the joint range, and nothing moves."""
    up, down = room(robot)
    way = up + TOO_FAR_RAD if up < down else -down - TOO_FAR_RAD
    if not np.isfinite(way):
        return  # a joint that turns for ever has no end to go beyond
    velocity, acceleration = _half(robot)
    for kind in KINDS:
        _refused(robot, line(robot, way, velocity, acceleration, kind), "leaves the joint range")


def a_velocity_beyond_the_limits_is_refused(robot: Robot) -> None:
    """The same for one that is faster than `limits.qd_max`."""
    _, acceleration = _half(robot)
    velocity = TOO_MUCH * float(robot.limits.qd_max[-1])
    for kind in KINDS:
        segment = _within_range(robot, velocity, acceleration, kind)
        _refused(robot, segment, f"asks for {np.abs(segment.qd).max():.2f} rad/s")


def an_acceleration_beyond_the_limits_is_refused(robot: Robot) -> None:
    """The same for one that needs more than `limits.qdd_max`."""
    velocity = 0.9 * float(robot.limits.qd_max[-1])
    acceleration = TOO_MUCH * float(robot.limits.qdd_max[-1])
    for kind in KINDS:
        segment = _within_range(robot, velocity, acceleration, kind)
        _refused(robot, segment, f"asks for {np.abs(segment.qdd).max():.1f} rad/s²")


def _half(robot: Robot) -> tuple[float, float]:
    limits = robot.limits
    return float(limits.qd_max[-1]) / 2, float(limits.qdd_max[-1]) / 2


def _within_range(
    robot: Robot, velocity: float, acceleration: float, kind: Literal["move", "trajectory"]
) -> Segment:
    """As far as it takes to get that fast; harder where there is no room for it."""
    up, down = room(robot)
    way = min(_RUN_UP * velocity**2 / acceleration, 0.9 * max(up, down))
    acceleration = max(acceleration, _RUN_UP * velocity**2 / way)
    return line(robot, way if up >= down else -way, velocity, acceleration, kind)


def _refused(robot: Robot, segment: Segment, what: str) -> None:
    here = standing_at(robot)
    raises(HilError, lambda: robot.prepare(segment), f"prepare of a {segment.kind} that {what}")
    raises(RobotError, robot.start, "start after prepare has refused")
    for row in rows_for(robot, WATCHED_S):
        moved = float(np.abs(row["q"] - here).max())
        assert moved < AT_SET_POINT_RAD, f"it was refused, and the arm has moved {moved:.3f} rad"
        assert not row["status"] & Status.MOVING, "it was refused, and rows say that the arm moves"


# Stops.


def stop_works_at_rest_and_again(robot: Robot) -> None:
    """`stop` is idempotent."""
    for which in ("at rest", "at rest, the second time"):
        stop_in_time(robot, which)


def stop_works_while_another_thread_reads(robot: Robot) -> None:
    """No call in progress delays it."""
    over = threading.Event()

    def read() -> None:
        with contextlib.suppress(HilError):
            while not over.is_set():
                robot.read()
                time.sleep(1e-3)  # what an engine does with the rows

    begin(robot, move(robot, LONG_WAY_RAD))
    thread = threading.Thread(target=read)
    thread.start()
    try:
        time.sleep(0.05)
        stop_in_time(robot, "while another thread reads")
    finally:
        over.set()
        thread.join()
    settle(robot)


CONNECTED: tuple[Check, ...] = (
    rows_are_state_rows_in_order,
    a_robot_at_rest_holds,
    what_was_not_prepared_does_not_start,
    a_move_ends_where_it_was_told,
    a_hold_of_one_set_point_holds,
    what_was_not_prepared_does_not_start,
    the_payload_is_read_back,
    a_read_waits_no_longer_than_it_may,
    rows_are_in_the_units_they_say,
    a_position_beyond_the_limits_is_refused,
    a_velocity_beyond_the_limits_is_refused,
    an_acceleration_beyond_the_limits_is_refused,
    stop_works_at_rest_and_again,
    stop_works_while_another_thread_reads,
)
"""Each leaves a connected robot at rest."""


def stop_ends_a_move(robot: Robot, bench: Bench) -> None:
    """It returns at once; the arm rests within 100 ms and its ramp, and can be moved again."""
    _ends(robot, "move", bench.move_ramp_rad_s2)


def stop_ends_a_trajectory(robot: Robot, bench: Bench) -> None:
    """The same while every set-point is given."""
    _ends(robot, "trajectory", bench.trajectory_ramp_rad_s2)


def _ends(robot: Robot, kind: Literal["move", "trajectory"], ramp_rad_s2: float) -> None:
    """Twice at most: a stop that had to be made another way may ask for `connect`, but not always.

    A computer that gives a driver no processor for a moment leaves it no other choice.
    """
    _rests(robot, kind, ramp_rad_s2)
    try:
        follow(robot, move(robot, 0.1))
    except RobotFault:
        robot.connect()
        _rests(robot, kind, ramp_rad_s2)
        follow(robot, move(robot, 0.1))


def _rests(robot: Robot, kind: Literal["move", "trajectory"], ramp_rad_s2: float) -> None:
    segment = move(robot, LONG_WAY_RAD, kind)
    begin(robot, segment)
    asked = float(robot.read()[-1]["device_time"])
    stop_in_time(robot, f"out of a {kind}")
    took = rest_time(robot) - asked
    allowed = STOP_S + segment.speed / ramp_rad_s2
    assert took <= allowed, (
        f"the arm was at rest {took:.3f} s after the stop of a {kind}; {allowed:.3f} s are allowed "
        f"at {segment.speed:.2f} rad/s with a ramp of {ramp_rad_s2:g} rad/s²"
    )
    settle(robot)
    left = np.abs(standing_at(robot) - segment.q[-1]).max()
    assert left > AT_SET_POINT_RAD, "the motion went on to its goal"


BENCH: tuple[BenchCheck, ...] = (
    stop_ends_a_move,
    stop_ends_a_trajectory,
)
"""The same, with a word about the robot's ramps."""


def a_stop_is_on_the_wire_in_time(robot: Robot, bench: Bench) -> None:
    """Within 100 ms of the request the controller has it, whatever the arm is doing."""
    assert bench.stop_seen is not None, "nobody sees the wire"
    for kind in KINDS:
        begin(robot, move(robot, LONG_WAY_RAD, kind))
        asked = time.monotonic()
        robot.stop()
        until = asked + SEEN_WITHIN_S
        while (seen := bench.stop_seen(asked)) is None and time.monotonic() < until:
            time.sleep(0.01)
        settle(robot)
        assert seen is not None, f"no stop came to the controller out of a {kind}"
        took = seen - asked
        assert took < STOP_S, f"the stop of a {kind} was on the wire after {took * 1e3:.0f} ms"


SEEN: tuple[BenchCheck, ...] = (a_stop_is_on_the_wire_in_time,)
"""The same, for a bench where somebody sees the wire."""


# Faults.


def a_fault_surfaces_in_the_next_read(robot: Robot, bench: Bench) -> None:
    """The read after the rows that show it raises `RobotFault`; nothing is obeyed until `connect`.

    Its robot is not connected, and not used any more afterwards.
    """
    assert bench.fault is not None, "nobody can make it fault"
    robot.connect()
    here = hold(robot)
    begin(robot, move(robot, LONG_WAY_RAD))
    bench.fault(robot)
    _until_it_raises(robot)
    stop_in_time(robot, "after a fault")
    raises(HilError, lambda: robot.prepare(here), "prepare after a fault")
    raises(RobotError, robot.start, "start after a fault")


def _until_it_raises(robot: Robot) -> None:
    wall = robot.capabilities.clock == "wall"
    first, until, shown = np.inf, time.monotonic() + FAULT_S, False
    while True:
        try:
            rows = robot.read()
        except RobotFault:
            return
        assert not shown, "rows showed a fault, and the read after them has not raised it"
        shown = bool((rows["status"] & int(Status.FAULT)).any())
        first = min(first, float(rows["device_time"][0]))
        passed = float(rows["device_time"][-1]) - first
        late = time.monotonic() > until if wall else passed > FAULT_S
        assert shown or not late, f"no read has told the fault within {FAULT_S:g} s"


FAULTY: tuple[BenchCheck, ...] = (a_fault_surfaces_in_the_next_read,)
"""Each needs a robot that is not connected, and a bench where it can be made to fault."""
