"""A segment as the drives take it: checked, in their integers, one row per cycle.

If the segment begins a little beside the held set-point, because a brake gave or a spring left the
arm there, the track first moves to the segment's start, in at least `REACHED_S`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hil.core import CommandRefused, FloatArray, IntArray
from hil.robot import Limits, Segment
from hil_drivers.arm import SPEED_SLACK, refused, require_executable
from hil_drivers.cia402.profile import Scaling, wrapped
from hil_drivers.cia402.torque import TorqueModel


@dataclass(frozen=True, eq=False)
class Track:
    """A motion as the drives take it, one row per cycle.

    Attributes:
        segment: Index of the plan's step.
        position: (N, n) of 607Ah, N ≥ 1; begins where the drives hold.
        velocity: (N, n) of 60FFh.
        torque: (N, n) feed-forward, ‰ as 6071h and 60B2h.
        holding: (N, n) what would hold the arm still there, in the same unit.
    """

    segment: int
    position: IntArray
    velocity: IntArray
    torque: IntArray
    holding: IntArray

    @cached_property
    def rows(self) -> list[tuple[list[int], list[int], list[int], list[int]]]:
        """Position, velocity, torque and holding torque row by row, as plain integers."""
        columns = (self.position, self.velocity, self.torque, self.holding)
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def between(self, at: float) -> tuple[list[int], list[int], list[int], list[int]]:
        """Return a row at a place between rows, counted from 0."""
        row = int(at)
        last = len(self.rows) - 1
        if row >= last:
            return self.rows[last]
        share, here, there = at - row, self.rows[row], self.rows[row + 1]
        position = [
            wrapped(p + round(share * wrapped(q - p)))
            for p, q in zip(here[0], there[0], strict=True)
        ]
        velocity, torque, holding = (
            [round(p + share * (q - p)) for p, q in zip(here[i], there[i], strict=True)]
            for i in (1, 2, 3)
        )
        return position, velocity, torque, holding

    def steps_at(self, at: float) -> list[int]:
        """Increments of position per row from a place on; zeros at the end."""
        row = int(at)
        if row >= len(self.rows) - 1:
            return [0] * len(self.rows[0][0])
        return [
            wrapped(q - p) for p, q in zip(self.rows[row][0], self.rows[row + 1][0], strict=True)
        ]


BEGINS_WITHIN_RAD = 1e-4
"""Largest distance from the held set-point to a segment's first row; drives do not smooth it."""

GIVEN_RAD = 2e-3
"""A brake may give when its axis is switched on, after the plan was made. Before the first motion
this much is corrected; between motions a correction would hide a mistake."""

LED_RAD = 0.05
"""Led by a spring (CST, CSV), an arm rests beside its set-point, where friction keeps it."""

REACHED_S = 0.4
"""Least duration of the way to the segment's start [s]."""


def track_of(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    rate_hz: float,
    scaling: Scaling,
    model: TorqueModel | None,
    *,
    led: bool = False,
    first: bool = False,
) -> Track:
    """A segment that can be executed, in the drives' integers.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (n,) the set-point that is held [rad].
        rate_hz: Rows per second of device time.
        scaling: Of the drives.
        model: Says the feed-forward torque; none is sent without.
        led: The master closes the position loop; the segment may begin `LED_RAD` from there.
        first: Nothing has moved since the axes were switched on; a brake may have given.

    Raises:
        CommandRefused: It leaves the limits, jumps, begins elsewhere or moves at its ends.
    """
    moves = segment.kind != "hold"
    tolerance = LED_RAD if led else GIVEN_RAD if first and moves else BEGINS_WITHIN_RAD
    require_executable(segment, limits, standing, at_set_point_rad=tolerance)
    require_smooth(segment, limits, rate_hz)
    q, qd, qdd = segment.q, segment.qd, segment.qdd
    if np.abs(q[0] - standing).max() > BEGINS_WITHIN_RAD:
        approach = _approach(standing, q[0], limits, rate_hz)
        q, qd, qdd = (np.vstack(pair) for pair in zip(approach, (q, qd, qdd), strict=True))
    torque = holding = np.zeros_like(q)
    if model is not None:
        torque, holding = model.torque(q, qd, qdd), model.holding(q)
    return Track(
        segment=segment.index,
        position=scaling.raw_position(q),
        velocity=scaling.raw_velocity(qd),
        torque=scaling.raw_torque(torque),
        holding=scaling.raw_torque(holding),
    )


def _approach(
    start: FloatArray, end: FloatArray, limits: Limits, rate_hz: float
) -> tuple[FloatArray, ...]:
    """Return (N, n) positions, velocities, accelerations from rest to rest within the limits.

    The polynomial of degree 5 has its highest speed, 15/8 of the mean one, in the middle, and its
    highest acceleration, 10/√3 of way / time², at (3 ± √3) / 6 of the time.
    """
    way = end - start
    fast = (15 / 8 * np.abs(way) / limits.qd_max).max()
    sharp = np.sqrt((10 / math.sqrt(3) * np.abs(way) / limits.qdd_max).max())
    rows = math.ceil(max(REACHED_S, fast, sharp) * rate_hz)
    lasts_s, t = rows / rate_hz, np.arange(rows)[:, None] / rows
    q = start + way * (10 * t**3 - 15 * t**4 + 6 * t**5)
    qd = way * (30 * t**2 - 60 * t**3 + 30 * t**4) / lasts_s
    qdd = way * (60 * t - 180 * t**2 + 120 * t**3) / lasts_s**2
    return q, qd, qdd


ACCELERATION_SLACK = 1.10
"""Second differences of sampled polynomials and rounded positions may be that much more."""

ROUNDING_RAD = 1e-8
"""Rounding error of a position; second differences add up to four of it."""


def require_smooth(segment: Segment, limits: Limits, rate_hz: float) -> None:
    """Refuse positions between which drives would jump.

    Args:
        segment: The next one.
        limits: Of the arm.
        rate_hz: Rows per second of device time.

    Raises:
        CommandRefused: Positions are farther apart than the fastest speed, bend more than the
            highest acceleration, do not begin and end at rest; or a hold moves.
    """
    if segment.kind == "hold" and len(segment.q) != 1:
        raise refused(f"{_where(segment)} has {len(segment.q)} rows: a hold has one")
    speed = np.abs(np.diff(segment.q, axis=0)).max(axis=0, initial=0.0) * rate_hz
    if (too_fast := np.flatnonzero(speed > limits.qd_max * SPEED_SLACK)).size:
        joint = int(too_fast[0])
        raise refused(
            f"{_where(segment)} has set-points of joint {joint + 1} that are {speed[joint]:.3f} "
            f"rad/s apart, {limits.qd_max[joint]:.3f} are allowed"
        )
    # At rest before the first row and after the last one: a segment that sets out or ends at
    # speed bends there.
    at_rest = np.vstack((segment.q[:1], segment.q, segment.q[-1:]))
    bends = np.abs(np.diff(at_rest, 2, axis=0)) * rate_hz**2
    most = limits.qdd_max * ACCELERATION_SLACK + 4 * ROUNDING_RAD * rate_hz**2
    if (bends > most).any():
        raise _too_sharp(segment, bends, limits.qdd_max)


def _too_sharp(segment: Segment, bends: FloatArray, most: FloatArray) -> CommandRefused:
    row, joint = np.unravel_index(int((bends / most).argmax()), bends.shape)
    place = {0: "sets out", len(bends) - 1: "ends"}.get(int(row), f"bends at row {row}")
    return refused(
        f"{_where(segment)} {place} with {bends[row, joint]:.1f} rad/s² of joint {joint + 1} by "
        f"its positions, {most[joint]:.3f} are allowed"
    )


def _where(segment: Segment) -> str:
    return f"segment {segment.index} ({segment.kind})"
