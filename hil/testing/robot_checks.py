"""What the contract of `hil.robot.Robot` says, as checks that raise `AssertionError`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from hil.arms import Payload
from hil.core import RobotConnectionError, RobotError, RobotTimeout
from hil.robot import HasResource, Robot, Status
from hil.testing.asserts import raises, stop_in_time
from hil.testing.bench import Bench
from hil.testing.limit_checks import (
    a_position_beyond_the_limits_is_refused,
    a_velocity_beyond_the_limits_is_refused,
    an_acceleration_beyond_the_limits_is_refused,
)
from hil.testing.moves import REST_RAD_S, follow, hold, move, standing_at
from hil.testing.stop_checks import (
    a_fault_surfaces_in_the_next_read,
    a_stop_is_on_the_wire_in_time,
    stop_ends_a_move,
    stop_ends_a_trajectory,
    stop_works_at_rest_and_again,
    stop_works_while_another_thread_reads,
)
from hil.testing.unit_checks import rows_are_in_the_units_they_say, rows_are_state_rows_in_order

Check: TypeAlias = Callable[[Robot], None]
BenchCheck: TypeAlias = Callable[[Robot, Bench], None]

_AT_GOAL_RAD = 0.01


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


def a_robot_at_rest_holds(robot: Robot) -> None:
    """Nobody moved it: no `MOVING`, no speed, no fault."""
    row = robot.read()[-1]
    assert not row["status"] & (Status.MOVING | Status.FAULT), f"status {row['status']} at rest"
    assert np.abs(row["qd"]).max() < REST_RAD_S, f"moves at {row['qd']} rad/s"


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


def what_was_not_prepared_does_not_start(robot: Robot) -> None:
    """`start` raises a `RobotError`, also when a segment was started before."""
    raises(RobotError, robot.start, "start with nothing prepared")


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

BENCH: tuple[BenchCheck, ...] = (
    stop_ends_a_move,
    stop_ends_a_trajectory,
)
"""The same, with a word about the robot's ramps."""

SEEN: tuple[BenchCheck, ...] = (a_stop_is_on_the_wire_in_time,)
"""The same, for a bench where somebody sees the wire."""

FAULTY: tuple[BenchCheck, ...] = (a_fault_surfaces_in_the_next_read,)
"""Each needs a robot that is not connected, and a bench where it can be made to fault."""
