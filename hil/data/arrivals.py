"""Arrival paths of static poses: the last millirad of the motion of each joint before a dwell.

Static friction depends on the motion that precedes a dwell. A joint that stops retains the friction
of its last motion, and sliding back by a tenth of a millirad reduces this friction. A model may use
the measured path into the pose as an input, but never the current in the pose. The path of a joint
begins at the time at which the joint last came within `NEAR_RAD` of its rest position, interpolated
between samples. This start time depends on positions alone; a dwell program, a passive recording
and a stream of samples therefore give the same path at any sample rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray

NEAR_RAD = 1e-3
"""Distance from the rest position at which an arrival path begins [rad]."""

ARRIVAL_STEP_S = 0.008
"""Time between two points of an arrival path [s]."""

ARRIVAL_POINTS = 24
"""Number of points in an arrival path.

Deceleration from `NEAR_RAD`, overshoot and sliding back together take about 0.1 s.
"""

ARRIVAL_Q, ARRIVAL_QD = 0, 1
"""Indices of position and velocity in the third axis of `Dataset.arrivals`."""

GAP_S = 0.04
"""Time step above which the motion between two samples counts as unknown [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Measured motion of an arm, from which arrival paths are computed.

    Attributes:
        t: (N,) increasing times [s].
        q, qd: (N, n) positions [rad] and velocities [rad/s].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray


def arrival(track: Track, first: float, last: float) -> FloatArray:
    """Return the arrival path of every joint into one dwell.

    Args:
        track: Motion that includes both the approach and the dwell.
        first: Start time of the dwell [s].
        last: End time of the dwell [s].

    Returns:
        (`ARRIVAL_POINTS`, 2, n) position relative to the rest position [rad] and velocity [rad/s].
        The path is NaN for a joint that has not moved by `NEAR_RAD` since the start of the track or
        since the last gap in time.
    """
    t = track.t
    begin, end = np.searchsorted(t, [first, last + 1e-9]).tolist()
    out = np.full((ARRIVAL_POINTS, 2, track.q.shape[1]), np.nan)
    rest = np.mean(track.q[begin:end], axis=0)
    for j in range(track.q.shape[1]):
        away = _last_away(t, track.q[:, j], begin, rest[j])
        if away is None:
            continue
        start = _entered(t[away : away + 2], track.q[away : away + 2, j] - rest[j])
        rows = slice(min(away, int(np.searchsorted(t, start - ARRIVAL_STEP_S))), end)
        motion = np.stack([track.q[rows, j] - rest[j], track.qd[rows, j]], axis=1)
        out[:, :, j] = _resampled(t[rows], motion, start)
    return out


_BLOCK_S = 2.0
"""Length of the blocks in which the motion history is searched backwards [s]."""


def _last_away(t: FloatArray, q: FloatArray, begin: int, rest: float) -> int | None:
    """Return the last row before `begin` that is farther than `NEAR_RAD` from `rest`.

    None is returned if no row is that far from `rest`, or if there is a gap in time after the row.
    """
    stop = begin
    while stop > 0:
        start = min(stop - 1, int(np.searchsorted(t, t[stop - 1] - _BLOCK_S)))
        away = np.flatnonzero(np.abs(q[start:stop] - rest) > NEAR_RAD)
        row = start + int(away[-1]) if len(away) else start
        if np.any(np.diff(t[row : stop + 1]) > GAP_S):
            return None
        if len(away):
            return row
        stop = start
    return None


def _entered(t: FloatArray, q: FloatArray) -> float:
    """Return the time at which a joint came near its rest position, between two rows [s].

    In the first of the two rows, the joint is farther than `NEAR_RAD` from the rest position.
    """
    # Commanded positions may jump. Then neither row is near, and the joint arrives after both rows.
    if q[0] == q[-1]:
        return float(t[-1])
    beyond = q[0] - np.copysign(NEAR_RAD, q[0])
    return float(t[0] + (t[1] - t[0]) * beyond / (q[0] - q[1]))


def _resampled(t: FloatArray, values: FloatArray, start: float) -> FloatArray:
    """Return (`ARRIVAL_POINTS`, k) values (N, k) at intervals of `ARRIVAL_STEP_S` from `start`.

    Beyond the end of the values, the last value is repeated. If rows are denser than the resampled
    points, the rows nearest to a point are averaged.
    """
    times = start + ARRIVAL_STEP_S * np.arange(ARRIVAL_POINTS)
    stop = int(np.searchsorted(t, times[-1] + ARRIVAL_STEP_S)) + 1
    point = (
        np.clip(np.rint((t[:stop] - start) / ARRIVAL_STEP_S).astype(np.int64), -1, ARRIVAL_POINTS)
        + 1
    )
    count = np.bincount(point)
    there = count > 0
    known = [
        np.bincount(point, weights=column)[there] / count[there]
        for column in (t[:stop], *values[:stop].T)
    ]
    return np.stack([np.interp(times, known[0], column) for column in known[1:]], axis=1)


def approach_directions(paths: FloatArray) -> FloatArray:
    """Return (D, n) the approach directions: +1 from below, −1 from above, 0 if unknown.

    Args:
        paths: (D, K, 2, n) arrival paths, as in `Dataset.arrivals`.
    """
    sign: FloatArray = np.nan_to_num(-np.sign(paths[:, 0, ARRIVAL_Q]))
    return sign
