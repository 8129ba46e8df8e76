"""Conformance checks of a driver against the contract of `hil.robot.Robot`.

>>> from hil.testing import robot_conformance
>>> robot_conformance(lambda: MyArm("bench", "ur5", address="192.0.2.7"))     # doctest: +SKIP

Each conformance check of a driver is a function that receives the robot. The name of the function
is the statement that is checked, and the function raises `AssertionError` with the observed
behavior if the statement is false. The conformance checks are grouped: before connecting, connected
and static, limits, stops, faults. The source code of each group ends with the tuple of checks that
`robot_conformance` uses. Checks that need more information than the robot object have a `Bench`
argument, which describes the deceleration of the robot, the observation of its commands and the
injection of faults.

After a failed check, the next check starts with a new robot object, so that the driver author gets
all failures at the same time. This module does not need pytest; the class `RobotConformance`
creates one pytest test per check.
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
"""Wall time limit for a call of `stop`, and for the arrival of the stop command at the
controller [s]."""
FAULT_S = 1.0
"""Time limit for reporting a fault, measured on the clock of `Capabilities.clock` [s]."""
SEEN_WITHIN_S = 1.0
"""Time limit for the test observer that waits for a stop command [s]."""


@dataclass(frozen=True, slots=True)
class Bench:
    """Test bench of a driver: properties of the robot that the checks need.

    Attributes:
        move_ramp_rad_s2: Deceleration of the last joint if a move is stopped [rad/s²].
        trajectory_ramp_rad_s2: Deceleration of the last joint if a trajectory is stopped [rad/s²].
        stop_seen: Function of a time of `time.monotonic` that returns the time, on the same clock,
            at which the first later stop command arrived at the controller; None if no stop command
            arrived. The source of the arrival time is the journal of a mock or a bus listener.
        fault: Function that causes a fault of the moving robot: over the side channel of a mock, or
            by asking an operator.
    """

    move_ramp_rad_s2: float = 2.0
    trajectory_ramp_rad_s2: float = 2.0
    stop_seen: Callable[[float], float | None] | None = None
    fault: Callable[[Robot], object] | None = None


class NotConforming(AssertionError):
    """Error for a driver that violates the contract; the message lists all failed checks.

    Attributes:
        failures: Description of each failure, by name of the check.
    """

    def __init__(self, failures: dict[str, str]) -> None:
        super().__init__("".join(f"\n{name}: {found}" for name, found in failures.items()))
        self.failures = failures


def robot_conformance(
    make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
) -> tuple[str, ...]:
    """Check a driver against the robot protocol; moves the last joint by up to 0.4 rad.

    Args:
        make_robot: Function that returns a new robot object, not connected. The robot is connected,
            moved, stopped and closed; a real robot needs free space around it.
        leave_out: Names of checks that are skipped.
        bench: Test bench. Checks that need features missing in the bench are skipped.

    Returns:
        Names of the checks that were completed.

    Raises:
        NotConforming: At least one check failed.
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
    """Type of the function that the fixture `robot_conformance` returns."""

    def __call__(
        self, make_robot: MakeRobot, *, leave_out: Sequence[str] = (), bench: Bench | None = None
    ) -> tuple[str, ...]:
        """See `robot_conformance`."""


def check_names() -> tuple[str, ...]:
    """Return the names of all checks, in the order of execution."""
    checks = (*BEFORE_AND_AFTER, *CONNECTED, *BENCH, *SEEN, *FAULTY)
    return tuple(dict.fromkeys(check.__name__ for check in checks))


def _kept(checks: Sequence[Check], leave_out: Sequence[str]) -> list[Check]:
    return [check for check in checks if check.__name__ not in leave_out]


def _at(bench: Bench, checks: Sequence[BenchCheck]) -> list[Check]:
    """Return the checks with their `bench` argument bound, with unchanged names."""

    def bound(check: BenchCheck) -> Check:
        @functools.wraps(check)
        def at_the_bench(robot: Robot) -> None:
            check(robot, bench)

        return at_the_bench

    return [bound(check) for check in checks]


def _alone(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """Run each check on a separate robot object, not connected; yield the failures."""
    for check in checks:
        with _closing(make_robot()) as robot:
            yield from _done(check, robot)


def _together(make_robot: MakeRobot, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """Run the checks on one connected robot, with a new object after every failure.

    Yield failures.
    """
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
    except Exception as error:  # a driver can raise any exception
        told = error.message if isinstance(error, HilError) else str(error)
        yield check.__name__, f"raised {type(error).__name__}: {told}"


@contextlib.contextmanager
def _closing(robot: Robot) -> Iterator[Robot]:
    """Stop and close the robot after a check, so that the arm is static before the next check."""
    try:
        yield robot
    finally:
        for step in (robot.stop, lambda: settle(robot), robot.close):
            with contextlib.suppress(Exception):
                step()


# Assertions used by several checks.


def raises(kind: type[HilError], call: Callable[[], object], what: str) -> None:
    """Raise `AssertionError` if a call does not raise an error of the expected class.

    Raises:
        AssertionError: The call raises an error of a different class, or no error.
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
    """Call the method `stop` and check its duration.

    Raises:
        AssertionError: The call takes longer than allowed.
    """
    asked = time.perf_counter()
    robot.stop()
    took = time.perf_counter() - asked
    assert took < STOP_S, f"stop {when} took {took * 1e3:.0f} ms"


# Before connecting, and after closing.


def names_rates_and_limits_are_known_before_connecting(robot: Robot) -> None:
    """Check that `capabilities` and `limits` are consistent and valid before connecting."""
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
    """Check that joint limits are positive finite numbers; drive gains can be unknown.

    The author of a driver that cannot know a limit skips this check and names the limit in the
    documentation of the driver.
    """
    can, limits = robot.capabilities, robot.limits
    for name in ("qd_max", "qdd_max", "effort_max"):
        known = np.isfinite(getattr(limits, name)) & (getattr(limits, name) > 0)
        lacking = [can.joint_names[i] for i in np.flatnonzero(~known)]
        assert not lacking, f"limits.{name} has no valid value for {', '.join(lacking)}"
    gains = np.array(can.drive_gains)
    assert len(gains) in (0, len(can.joint_names)), (
        f"{len(gains)} drive gains for {len(can.joint_names)} joints"
    )
    assert (np.isfinite(gains) & (gains != 0)).all(), f"drive gains {can.drive_gains}"


def a_robot_in_wall_time_says_which_one_it_is(robot: Robot) -> None:
    """Check that a robot with a wall clock has a `resource`, independent of the station file.

    Without a `resource`, two processes could command the same arm at the same time. For a
    simulation that is private to its process, the driver author skips this check.
    """
    if robot.capabilities.clock == "virtual":
        return
    assert isinstance(robot, HasResource), "the robot has no `resource`, such as its address"
    said = robot.resource
    assert isinstance(said, str), f"`resource` is {said!r}, not text"
    assert said.strip(), "`resource` is empty"


def nobody_is_there_before_connecting(robot: Robot) -> None:
    """Check that `identity` and `read` raise `RobotConnectionError` before connecting."""
    raises(RobotConnectionError, lambda: robot.identity, "identity before connect")
    raises(RobotConnectionError, robot.read, "read before connect")


def stop_works_before_connecting(robot: Robot) -> None:
    """Check that `stop` before connecting raises no error."""
    stop_in_time(robot, "before connect")


def connecting_twice_is_connecting_once(robot: Robot) -> None:
    """Check that `connect` is idempotent."""
    robot.connect()
    before = robot.identity
    robot.connect()
    assert robot.identity == before, f"after the second connect: {robot.identity}, not {before}"
    robot.read()


def a_closed_robot_is_gone(robot: Robot) -> None:
    """Check that `close` and `stop` are idempotent and that `read` raises if closed."""
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
"""Checks that need a robot that is not connected."""


# Connected: rows, moves and the payload.


def rows_are_state_rows_in_order(robot: Robot) -> None:
    """Check that `read` returns rows of `state_dtype(n)` with increasing device time."""
    blocks = [robot.read() for _ in range(5)]
    expected = state_dtype(len(robot.capabilities.joint_names))
    for block in blocks:
        assert len(block), "a block without rows"
        assert block.dtype == expected, f"rows are {block.dtype}, not {expected}"
    times = np.concatenate(blocks)["device_time"]
    assert np.isfinite(times).all(), "a device time is not a number"
    assert (np.diff(times) > 0).all(), "device times do not increase strictly"


def a_robot_at_rest_holds(robot: Robot) -> None:
    """Check that a static robot has no `MOVING` bit, no speed and no fault."""
    row = robot.read()[-1]
    assert not row["status"] & (Status.MOVING | Status.FAULT), f"status {row['status']} at rest"
    assert np.abs(row["qd"]).max() < REST_RAD_S, f"moves at {row['qd']} rad/s"


def what_was_not_prepared_does_not_start(robot: Robot) -> None:
    """Check that `start` without a prepared segment raises a `RobotError`.

    This check is also made after an earlier segment was started.
    """
    raises(RobotError, robot.start, "start with nothing prepared")


_AT_GOAL_RAD = 0.01


def a_move_ends_where_it_was_told(robot: Robot) -> None:
    """Check that the rows of a move contain its segment number; `MOVING` ends at the goal."""
    segment = move(robot, 0.1)
    mine = follow(robot, segment)
    off = np.abs(mine[-1]["q"] - segment.q[-1]).max()
    assert off < _AT_GOAL_RAD, f"ended {off:.4f} rad away from the goal"
    assert (np.diff(mine["device_time"]) > 0).all(), "device times do not increase strictly"


def a_hold_of_one_set_point_holds(robot: Robot) -> None:
    """Check a hold of one set-point: rows have its segment number, the arm does not move."""
    here = standing_at(robot)
    mine = follow(robot, hold(robot))
    off = np.abs(mine[-1]["q"] - here).max()
    assert off < _AT_GOAL_RAD, f"a hold has moved by {off:.4f} rad"


def the_payload_is_read_back(robot: Robot) -> None:
    """Check that `set_payload` returns the declared payload, with and without a payload."""
    mass = min(1.0, robot.limits.payload_max_kg / 2)
    declared = Payload(mass, (0.0, 0.01, 0.04))
    for payload in (declared, Payload()):
        told = robot.set_payload(payload)
        assert payload.agrees_with(told), f"declared {payload}, read back {told}"


def a_read_waits_no_longer_than_it_may(robot: Robot) -> None:
    """Check that a very short time-out yields rows or `RobotTimeout`.

    The next read must work in both cases.
    """
    asked = time.monotonic()
    with contextlib.suppress(RobotTimeout):
        robot.read(1e-4)
    took = time.monotonic() - asked
    assert took < 2.0, f"read(timeout_s=1e-4) took {took:.2f} s"
    assert len(robot.read()), "a block without rows"


OUTSIDE_RAD = 0.1
BESIDE_RAD = 0.02
"""Maximum difference between integrated velocity and position [rad], which allows a delay of 60
ms."""
RATE_SHARE = 0.01
CLOCKS_S = 10.0
EFFORT_SHARE = 1.2
COLDEST_C, HOTTEST_C = -20.0, 120.0


def rows_are_in_the_units_they_say(robot: Robot) -> None:
    """Check the units of the rows of a slow move: rad, rad/s, s, °C, Unix time, and A or N·m."""
    can, limits = robot.capabilities, robot.limits
    rows = follow(robot, move(robot, LONG_WAY_RAD))
    t, q, qd = rows["device_time"], rows["q"], rows["qd"]

    outside = np.maximum(limits.q_min - q, q - limits.q_max).max()
    assert outside < OUTSIDE_RAD, f"q is {outside:.2f} outside the joint range: is it in rad?"

    steps = (qd[1:] + qd[:-1]) / 2 * np.diff(t)[:, None]
    beside = np.abs(np.cumsum(steps, axis=0) - (q[1:] - q[0])).max()
    assert beside < BESIDE_RAD, (
        f"qd integrated over device time ends {beside:.3f} rad away from q: is qd in rad/s and "
        "device time in s?"
    )

    measured = 1.0 / float(np.median(np.diff(t)))
    assert abs(measured - can.rate_hz) < RATE_SHARE * can.rate_hz, (
        f"measured rate {measured:.4g} Hz (device time), capabilities state {can.rate_hz:g} Hz"
    )
    if can.clock == "wall":
        off = abs(float(rows["host_time"][-1]) - time.time())
        assert off < CLOCKS_S, f"host_time is {off:.1f} s off Unix time"

    # A current can be compared with a limit in N·m only if the drive gains are known.
    if can.effort_kind == "torque" or can.drive_gains:
        gains = np.abs(can.drive_gains) if can.effort_kind == "current" else 1.0
        torque: FloatArray = np.abs(rows["effort"]) * gains
        # A NaN effort was not measured and passes the check.
        too_much = (torque > EFFORT_SHARE * limits.effort_max).any(axis=0)
        named = [can.joint_names[i] for i in np.flatnonzero(too_much)]
        assert not named, (
            f"effort of {', '.join(named)} exceeds effort_max in a slow move: is it a "
            f"{can.effort_kind}, as capabilities state?"
        )

    known = rows["temperature"][np.isfinite(rows["temperature"])]
    plausible = (known > COLDEST_C) & (known < HOTTEST_C)
    assert plausible.all(), f"a temperature of {known[~plausible][0]:g}: is it in °C?"


# Limits: an impossible segment is rejected before any motion.

TOO_FAR_RAD = 0.2
TOO_MUCH = 1.5
"""Ratio of the requested speed or acceleration to its limit in the limit checks."""
_RUN_UP = 2.2
"""Distance needed for acceleration and deceleration, as a factor of velocity squared divided by
acceleration."""
WATCHED_S = 0.2


def a_position_beyond_the_limits_is_refused(robot: Robot) -> None:
    """Check that `prepare` rejects a segment beyond the joint range, without motion."""
    up, down = room(robot)
    way = up + TOO_FAR_RAD if up < down else -down - TOO_FAR_RAD
    if not np.isfinite(way):
        return  # a continuous joint has no limit
    velocity, acceleration = _half(robot)
    for kind in KINDS:
        _refused(robot, line(robot, way, velocity, acceleration, kind), "leaves the joint range")


def a_velocity_beyond_the_limits_is_refused(robot: Robot) -> None:
    """Check that `prepare` rejects a segment faster than `limits.qd_max`, without motion."""
    _, acceleration = _half(robot)
    velocity = TOO_MUCH * float(robot.limits.qd_max[-1])
    for kind in KINDS:
        segment = _within_range(robot, velocity, acceleration, kind)
        _refused(robot, segment, f"asks for {np.abs(segment.qd).max():.2f} rad/s")


def an_acceleration_beyond_the_limits_is_refused(robot: Robot) -> None:
    """Check that `prepare` rejects a segment beyond `limits.qdd_max`, without motion."""
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
    """Return a segment in which the last joint reaches the velocity.

    The acceleration is increased if the distance to the joint limit is short.
    """
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
        assert moved < AT_SET_POINT_RAD, f"it was refused, but the arm has moved {moved:.3f} rad"
        assert not row["status"] & Status.MOVING, "it was refused, but rows report a moving arm"


# Stops.


def stop_works_at_rest_and_again(robot: Robot) -> None:
    """Check that `stop` is idempotent."""
    for which in ("at rest", "at rest, the second time"):
        stop_in_time(robot, which)


def stop_works_while_another_thread_reads(robot: Robot) -> None:
    """Check that a `read` in progress does not delay `stop`."""
    over = threading.Event()

    def read() -> None:
        with contextlib.suppress(HilError):
            while not over.is_set():
                robot.read()
                time.sleep(1e-3)  # time in which an engine processes the rows

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
"""Checks that need a connected static robot and leave the robot static."""


def stop_ends_a_move(robot: Robot, bench: Bench) -> None:
    """Check that `stop` in a move returns at once and that the arm stops on its ramp.

    After the stop, the arm must be static within 100 ms plus the duration of the ramp, and must be
    movable again.
    """
    _ends(robot, "move", bench.move_ramp_rad_s2)


def stop_ends_a_trajectory(robot: Robot, bench: Bench) -> None:
    """Check that `stop` in a trajectory returns at once and that the arm stops on its ramp."""
    _ends(robot, "trajectory", bench.trajectory_ramp_rad_s2)


def _ends(robot: Robot, kind: Literal["move", "trajectory"], ramp_rad_s2: float) -> None:
    """Check a stop, and repeat the check a single time if the driver requires `connect`.

    A driver that gets no processor time on a busy computer possibly has to stop the arm by a
    different method, after which a call of `connect` is required. A driver must not require a call
    of `connect` after every stop.
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
    assert left > AT_SET_POINT_RAD, "the motion continued to its goal"


BENCH: tuple[BenchCheck, ...] = (
    stop_ends_a_move,
    stop_ends_a_trajectory,
)
"""Checks that need a connected static robot and the deceleration in `Bench`."""


def a_stop_is_on_the_wire_in_time(robot: Robot, bench: Bench) -> None:
    """Check that a stop command reaches the controller within 100 ms, in any motion."""
    assert bench.stop_seen is not None, "the bench does not observe the wire"
    for kind in KINDS:
        begin(robot, move(robot, LONG_WAY_RAD, kind))
        asked = time.monotonic()
        robot.stop()
        until = asked + SEEN_WITHIN_S
        while (seen := bench.stop_seen(asked)) is None and time.monotonic() < until:
            time.sleep(0.01)
        settle(robot)
        assert seen is not None, f"no stop reached the controller during a {kind}"
        took = seen - asked
        assert took < STOP_S, f"the stop of a {kind} was on the wire after {took * 1e3:.0f} ms"


SEEN: tuple[BenchCheck, ...] = (a_stop_is_on_the_wire_in_time,)
"""Checks that need a connected static robot and `Bench.stop_seen`."""


# Faults.


def a_fault_surfaces_in_the_next_read(robot: Robot, bench: Bench) -> None:
    """Check that the call of `read` after a row with a fault raises `RobotFault`.

    After a fault, the driver must reject all commands until `connect` is called. The robot is not
    connected before this check and is not used after this check.
    """
    assert bench.fault is not None, "the bench cannot cause a fault"
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
        assert not shown, "rows reported a fault, but the next read did not raise it"
        shown = bool((rows["status"] & int(Status.FAULT)).any())
        first = min(first, float(rows["device_time"][0]))
        passed = float(rows["device_time"][-1]) - first
        late = time.monotonic() > until if wall else passed > FAULT_S
        assert shown or not late, f"no read has raised the fault within {FAULT_S:g} s"


FAULTY: tuple[BenchCheck, ...] = (a_fault_surfaces_in_the_next_read,)
"""Checks that need a robot that is not connected and `Bench.fault`."""
