"""Arrivals: how each joint came to rest before a dwell, over the last millirad of its path.

Stick friction has a memory. A joint that stops keeps the friction of its last motion, and sliding
back by a tenth of a millirad takes part of that away. A model may know the measured path into the
pose, never the current there. The path of every joint begins where it came within `NEAR_RAD` of its
place of rest for the last time, between two samples if need be. That depends on positions alone,
so a dwell program, a passive recording and a stream of samples are all treated the same, at any
sample rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray

NEAR_RAD = 1e-3
"""Where the path begins, measured from the place of rest [rad]."""

ARRIVAL_STEP_S = 0.008
"""Time between two points of a path [s]."""

ARRIVAL_POINTS = 24
"""Points of a path: deceleration from `NEAR_RAD`, overshoot and slide back take about 0.1 s."""

ARRIVAL_Q, ARRIVAL_QD = 0, 1
"""Index of position and velocity in the third axis of `Dataset.arrivals`."""

GAP_S = 0.04
"""After a longer step in time it is unknown how a joint came to where it is [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Motion of an arm, sample by sample.

    Attributes:
        t: (N,) advancing times [s].
        q, qd: (N, n) positions [rad] and velocities [rad/s].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray


def arrival(track: Track, first: float, last: float) -> FloatArray:
    """Return the path of every joint into one dwell.

    Args:
        track: The motion into the dwell, and the dwell.
        first: Time from which the arm is at rest [s].
        last: Time until which it is at rest [s].

    Returns:
        (`ARRIVAL_POINTS`, 2, n): position relative to the place of rest [rad] and velocity [rad/s];
        NaN for a joint that has not moved by `NEAR_RAD` since the track began, or since a gap in
        it.
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
"""History is searched backwards in pieces of this length [s]."""


def _last_away(t: FloatArray, q: FloatArray, begin: int, rest: float) -> int | None:
    """Return the last row before `begin` that is not near `rest`; None if there is none.

    None also where there is a gap in time after that row.
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
    """Return when a joint, away in the first of two rows and near in the second, came near [s]."""
    # Commanded poses may jump: neither row is near, and the joint is there after them.
    if q[0] == q[-1]:
        return float(t[-1])
    beyond = q[0] - np.copysign(NEAR_RAD, q[0])
    return float(t[0] + (t[1] - t[0]) * beyond / (q[0] - q[1]))


def _resampled(t: FloatArray, values: FloatArray, start: float) -> FloatArray:
    """Return (`ARRIVAL_POINTS`, k) of values (N, k): every `ARRIVAL_STEP_S` from a time on.

    The last value is repeated. Where rows are denser, those nearest to a point are averaged.
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
    """Return (D, n) the side each joint came from: +1 below, −1 above, 0 if unknown.

    Args:
        paths: (D, K, 2, n) as in `Dataset.arrivals`.
    """
    sign: FloatArray = np.nan_to_num(-np.sign(paths[:, 0, ARRIVAL_Q]))
    return sign
