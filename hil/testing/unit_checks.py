"""Rows of the right kind, in the units and at the rate that a robot states, as checks."""

from __future__ import annotations

import time

import numpy as np

from hil.core import FloatArray, StructArray
from hil.robot import Robot, state_dtype
from hil.testing.moves import LONG_WAY_RAD, follow, move

OUTSIDE_RAD = 0.1
BESIDE_RAD = 0.02
"""How far the integral of the velocity may be from the position: a lag of 60 ms [rad]."""

RATE_SHARE = 0.01
EFFORT_SHARE = 1.2
COLDEST_C, HOTTEST_C = -20.0, 120.0
CLOCKS_S = 10.0


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


def rows_are_in_the_units_they_say(robot: Robot) -> None:
    """Rad, rad/s, s, °C, Unix time, and A or N·m, as far as rows of a slow move can tell."""
    rows = follow(robot, move(robot, LONG_WAY_RAD))
    _positions(robot, rows)
    _velocities(rows)
    _times(robot, rows)
    _efforts(robot, rows)
    _temperatures(rows)


def _positions(robot: Robot, rows: StructArray) -> None:
    limits, q = robot.limits, rows["q"]
    outside = np.maximum(limits.q_min - q, q - limits.q_max).max()
    assert outside < OUTSIDE_RAD, f"q is {outside:.2f} outside the joint range: is it in rad?"


def _velocities(rows: StructArray) -> None:
    t, q, qd = rows["device_time"], rows["q"], rows["qd"]
    steps = (qd[1:] + qd[:-1]) / 2 * np.diff(t)[:, None]
    beside = np.abs(np.cumsum(steps, axis=0) - (q[1:] - q[0])).max()
    assert beside < BESIDE_RAD, (
        f"qd summed up over device time ends {beside:.3f} rad beside q: is qd in rad/s and device "
        "time in s?"
    )


def _times(robot: Robot, rows: StructArray) -> None:
    rate = robot.capabilities.rate_hz
    said = 1.0 / float(np.median(np.diff(rows["device_time"])))
    assert abs(said - rate) < RATE_SHARE * rate, (
        f"rows are {said:.4g} a second of device time, capabilities say {rate:g}"
    )
    if robot.capabilities.clock == "wall":
        off = abs(float(rows["host_time"][-1]) - time.time())
        assert off < CLOCKS_S, f"host_time is {off:.1f} s off Unix time"


def _efforts(robot: Robot, rows: StructArray) -> None:
    can, most = robot.capabilities, EFFORT_SHARE * robot.limits.effort_max
    torque: FloatArray = np.abs(rows["effort"])
    if can.effort_kind == "current":
        if not can.drive_gains:
            return
        torque = torque * np.abs(can.drive_gains)
    too_much = (torque > most).any(axis=0)  # not a number is not measured, and not too much
    named = [can.joint_names[i] for i in np.flatnonzero(too_much)]
    assert not named, (
        f"effort of {', '.join(named)} is beyond effort_max in a slow move: is it the "
        f"{can.effort_kind} that capabilities say?"
    )


def _temperatures(rows: StructArray) -> None:
    known = rows["temperature"][np.isfinite(rows["temperature"])]
    plausible = (known > COLDEST_C) & (known < HOTTEST_C)
    assert plausible.all(), f"a temperature of {known[~plausible][0]:g}: is it in °C?"
