"""How each joint came to rest before a dwell: the last millirad of its way, sample by sample.

Stick friction has a memory. A joint that stops keeps the friction its last motion left it with, and
a slide back by a tenth of a millirad takes part of that away. What a model may know of it is the
measured path into the pose, never the current there. The path of every joint begins where it
came within `NEAR_RAD` of its place of rest for the last time, between two samples if need be; that
is seen in the positions alone, so that a program, a recording nobody planned and a stream of
samples are all treated the same, at any sample rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray

NEAR_RAD = 1e-3
"""Where the path begins, measured from the place of rest [rad]."""

STEP_S = 0.008
"""Distance of the points of a path in time [s]."""

POINTS = 24
"""Points of a path: deceleration from `NEAR_RAD`, overshoot and slide back take about 0.1 s."""

Q, QD = 0, 1
"""Index of position and velocity in the third axis of arrivals."""

GAP_S = 0.04
"""After a longer step in time nobody knows any more how a joint came to where it is [s]."""

_BLOCK_S = 2.0
"""History is searched backwards in pieces of this length [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where an arm was, sample by sample.

    Attributes:
        t: (N,) advancing times [s].
        q, qd: (N, n) positions [rad] and velocities [rad/s].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray


def arrival(track: Track, first: float, last: float) -> FloatArray:
    """The path of every joint into one dwell.

    Args:
        track: The motion that led there, and the dwell.
        first: From this time on the arm is at rest [s].
        last: Until then [s].

    Returns:
        (`POINTS`, 2, n): position relative to the place of rest [rad] and velocity [rad/s]; NaN
        for a joint that has not moved by `NEAR_RAD` since the track began, or since a gap in it.
    """
    t = track.t
    begin, end = np.searchsorted(t, [first, last + 1e-9]).tolist()
    out = np.full((POINTS, 2, track.q.shape[1]), np.nan)
    rest = np.mean(track.q[begin:end], axis=0)
    for j in range(track.q.shape[1]):
        away = _last_away(t, track.q[:, j], begin, rest[j])
        if away is None:
            continue
        start = _crossing(t[away : away + 2], track.q[away : away + 2, j] - rest[j])
        rows = slice(min(away, int(np.searchsorted(t, start - STEP_S))), end)
        motion = np.stack([track.q[rows, j] - rest[j], track.qd[rows, j]], axis=1)
        out[:, :, j] = sampled(t[rows], motion, start)
    return out


def sampled(t: FloatArray, values: FloatArray, start: float) -> FloatArray:
    """(`POINTS`, k) values (N, k) every `STEP_S` from a time on, the last one repeated.

    Where rows are denser than that, those nearest to a point are averaged.
    """
    times = start + STEP_S * np.arange(POINTS)
    stop = int(np.searchsorted(t, times[-1] + STEP_S)) + 1
    point = np.clip(np.rint((t[:stop] - start) / STEP_S).astype(np.int64), -1, POINTS) + 1
    count = np.bincount(point)
    there = count > 0
    known = [
        np.bincount(point, weights=column)[there] / count[there]
        for column in (t[:stop], *values[:stop].T)
    ]
    return np.stack([np.interp(times, known[0], column) for column in known[1:]], axis=1)


def directions(paths: FloatArray) -> FloatArray:
    """(D, n) which way each joint came: +1 from below, −1 from above, 0 where nobody knows."""
    sign: FloatArray = np.nan_to_num(-np.sign(paths[:, 0, Q]))
    return sign


def _last_away(t: FloatArray, q: FloatArray, begin: int, rest: float) -> int | None:
    """The last row before `begin` not near `rest`; None without one, or with a gap since then."""
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


def _crossing(t: FloatArray, q: FloatArray) -> float:
    """When a joint that is away in the first of two rows and near in the second came near [s]."""
    if q[0] == q[-1]:  # commanded poses that jump: it came with the next row, or is there only now
        return float(t[-1])
    beyond = q[0] - np.copysign(NEAR_RAD, q[0])
    return float(t[0] + (t[1] - t[0]) * beyond / (q[0] - q[1]))
