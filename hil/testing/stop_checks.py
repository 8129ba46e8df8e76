"""Stops and faults as the contract of `hil.robot.Robot` has them, as checks."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Literal

import numpy as np

from hil.core import HilError, RobotError, RobotFault
from hil.robot import Robot, Status
from hil.testing.asserts import STOP_S, raises, stop_in_time
from hil.testing.bench import Bench
from hil.testing.moves import (
    AT_SET_POINT_RAD,
    LONG_WAY_RAD,
    begin,
    follow,
    hold,
    move,
    rest_time,
    settle,
    standing_at,
)

FAULT_S = 1.0
"""How soon a fault has to be told, by the clock of `Capabilities.clock` [s]."""

SEEN_WITHIN_S = 1.0
"""How long a witness may take to say what it saw [s]."""


def stop_works_at_rest_and_again(robot: Robot) -> None:
    """`stop` is idempotent."""
    for which in ("at rest", "at rest, the second time"):
        stop_in_time(robot, which)


def stop_ends_a_move(robot: Robot, bench: Bench) -> None:
    """It returns at once; the arm rests within 100 ms and its ramp, and can be moved again."""
    _ends(robot, "move", bench.move_ramp_rad_s2)


def stop_ends_a_trajectory(robot: Robot, bench: Bench) -> None:
    """The same while every set-point is given."""
    _ends(robot, "trajectory", bench.trajectory_ramp_rad_s2)


def a_stop_is_on_the_wire_in_time(robot: Robot, bench: Bench) -> None:
    """Within 100 ms of the request the controller has it, whatever the arm is doing."""
    assert bench.stop_seen is not None, "nobody sees the wire"
    kinds: tuple[Literal["move", "trajectory"], ...] = ("move", "trajectory")
    for kind in kinds:
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


def stop_works_while_another_thread_reads(robot: Robot) -> None:
    """No call in progress delays it."""
    begin(robot, move(robot, LONG_WAY_RAD))
    over = threading.Event()
    thread = threading.Thread(target=_read_until, args=(robot, over))
    thread.start()
    try:
        time.sleep(0.05)
        stop_in_time(robot, "while another thread reads")
    finally:
        over.set()
        thread.join()
    settle(robot)


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


def _read_until(robot: Robot, over: threading.Event) -> None:
    with contextlib.suppress(HilError):
        while not over.is_set():
            robot.read()
            time.sleep(1e-3)  # what an engine does with the rows
