"""Segment of a plan, checked and converted to the drives' integers, one row per cycle.

A segment can begin at a small distance from the held set-point, because a brake slipped, or because
friction stops an arm under position control by the master beside its set-point. If a segment begins
at a distance, the track first moves from the held set-point to the start of the segment, in at
least `REACHED_S`.
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
    """Motion in the drives' integers, one row per cycle.

    Attributes:
        segment: Index of the step of the plan.
        position: (N, n) raw target positions (607Ah), N ≥ 1; the first row is the held position.
        velocity: (N, n) velocities (60FFh).
        torque: (N, n) feed-forward torques [‰ of rated torque], as in 6071h and 60B2h.
        holding: (N, n) torques that hold the arm static at the same positions [‰ of rated torque].
    """

    segment: int
    position: IntArray
    velocity: IntArray
    torque: IntArray
    holding: IntArray

    @cached_property
    def rows(self) -> list[tuple[list[int], list[int], list[int], list[int]]]:
        """Rows of position, velocity, torque and holding torque as plain integers."""
        columns = (self.position, self.velocity, self.torque, self.holding)
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def between(self, at: float) -> tuple[list[int], list[int], list[int], list[int]]:
        """Return a row interpolated between two rows; `at` is the row number with its fraction."""
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
        """Return the position differences from row `at` to the next row; zeros at the last row."""
        row = int(at)
        if row >= len(self.rows) - 1:
            return [0] * len(self.rows[0][0])
        return [
            wrapped(q - p) for p, q in zip(self.rows[row][0], self.rows[row + 1][0], strict=True)
        ]


BEGINS_WITHIN_RAD = 1e-4
"""Largest distance from the held set-point to a segment's first row [rad].

Drives do not smooth the step from the held set-point to the first row.
"""

GIVEN_RAD = 2e-3
"""Largest distance from the held set-point to the segment's start, before the first motion [rad].

After the plan was made, a brake can slip when its axis is switched on. The arm moves to the start
only before the first motion; between motions a correction would hide an error.
"""

LED_RAD = 0.05
"""Largest distance from the held set-point to the segment's start in CST and CSV [rad].

Under position control by the master, friction keeps an arm beside its set-point.
"""

REACHED_S = 0.4
"""Minimum duration of the motion from the held set-point to the segment's start [s]."""


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
    """Check a segment and convert its samples to the drives' integers.

    Args:
        segment: Next segment.
        limits: Position, speed, acceleration and torque limits of the arm.
        standing: (n,) joint positions that the arm holds before the segment [rad].
        rate_hz: Number of rows per second of device time [Hz].
        scaling: Scaling of the drives.
        model: Torque model for the feed-forward torque; None for zero torques.
        led: Whether the master closes the position loop; if True, the segment can begin at a
            distance of up to `LED_RAD`.
        first: Whether this is the first motion since the axes were switched on, so that a brake
            possibly slipped.

    Raises:
        CommandRefused: The segment leaves the limits, jumps, does not begin at the held set-point,
            or has a speed other than 0 at its first or last sample.
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
    """Return (N, n) positions, velocities, accelerations from rest to rest, within the limits.

    The motion is a polynomial of degree 5. The highest speed, 15/8 of the mean speed, is in the
    middle of the motion. The highest acceleration, 10/√3 of distance / time², is at (3 ± √3) / 6 of
    the duration.
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
"""Tolerance factor of accelerations, which covers second differences of sampled polynomials."""

ROUNDING_RAD = 1e-8
"""Rounding error of a position [rad]; second differences contain up to four of these errors."""


def require_smooth(segment: Segment, limits: Limits, rate_hz: float) -> None:
    """Raise if the positions of a segment require jumps of the drives.

    Args:
        segment: Next segment.
        limits: Position, speed, acceleration and torque limits of the arm.
        rate_hz: Number of rows per second of device time [Hz].

    Raises:
        CommandRefused: The positions require more than the maximum speed or acceleration, or do not
            begin and end at rest; or a hold has more than one row.
    """
    if segment.kind == "hold" and len(segment.q) != 1:
        raise refused(f"{_where(segment)} has {len(segment.q)} set-points, a hold has one")
    speed = np.abs(np.diff(segment.q, axis=0)).max(axis=0, initial=0.0) * rate_hz
    if (too_fast := np.flatnonzero(speed > limits.qd_max * SPEED_SLACK)).size:
        joint = int(too_fast[0])
        raise refused(
            f"{_where(segment)} has set-points that move joint {joint + 1} with "
            f"{speed[joint]:.3f} rad/s; the limit is {limits.qd_max[joint]:.3f} rad/s"
        )
    # The arm is at rest before the first row and after the last one, so a segment that begins or
    # ends at speed has a large second difference there.
    at_rest = np.vstack((segment.q[:1], segment.q, segment.q[-1:]))
    bends = np.abs(np.diff(at_rest, 2, axis=0)) * rate_hz**2
    most = limits.qdd_max * ACCELERATION_SLACK + 4 * ROUNDING_RAD * rate_hz**2
    if (bends > most).any():
        raise _too_sharp(segment, bends, limits.qdd_max)


def _too_sharp(segment: Segment, bends: FloatArray, most: FloatArray) -> CommandRefused:
    row, joint = np.unravel_index(int((bends / most).argmax()), bends.shape)
    place = {0: "at its beginning", len(bends) - 1: "at its end"}.get(int(row), f"at row {row}")
    return refused(
        f"{_where(segment)} accelerates joint {joint + 1} {place} with "
        f"{bends[row, joint]:.1f} rad/s², computed from its positions; the limit is "
        f"{most[joint]:.3f} rad/s²"
    )


def _where(segment: Segment) -> str:
    return f"segment {segment.index} ({segment.kind})"
