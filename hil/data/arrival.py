"""How each joint came to rest before a dwell: the last millirad of its way, sample by sample.

Stick friction has a memory. A joint that stops keeps the friction its last motion left it with, and
a slide back by a tenth of a millirad takes part of that away. What a model may know of it is the
measured path into the pose, never the current there. The path of every joint begins where it
came within `NEAR_RAD` of its place of rest for the last time; that is seen in the positions alone,
so that a program, a recording nobody planned and a stream of samples are all treated the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.typing import FloatArray

NEAR_RAD = 1e-3
"""Where the path begins, measured from the place of rest [rad]."""

STEP_S = 0.008
"""Distance of the points of a path in time [s]."""

POINTS = 24
"""Points of a path: deceleration from `NEAR_RAD`, overshoot and slide back take about 0.1 s."""

Q, QD = 0, 1
"""Index of position and velocity in the third axis of arrivals."""

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
        for a joint that has not moved by `NEAR_RAD` since the track began.
    """
    t = track.t
    begin, end = np.searchsorted(t, [first, last + 1e-9]).tolist()
    out = np.full((POINTS, 2, track.q.shape[1]), np.nan)
    rest = np.mean(track.q[begin:end], axis=0)
    for j in range(track.q.shape[1]):
        q, qd = track.q[:, j], track.qd[:, j]
        came = _came_near(t, q, begin, rest[j])
        if came is not None:
            out[:, Q, j] = sampled(t, q, came, end) - rest[j]
            out[:, QD, j] = sampled(t, qd, came, end)
    return out


def sampled(t: FloatArray, values: FloatArray, start: int, end: int) -> FloatArray:
    """(`POINTS`,) values every `STEP_S` from row `start`, the last one before `end` repeated.

    Where rows are denser than that, those nearest to a point are averaged.
    """
    times = t[start] + STEP_S * np.arange(POINTS)
    stop = min(end, int(np.searchsorted(t, times[-1] + STEP_S)))
    near, known = t[start:stop], values[start:stop]
    point = np.clip(np.rint((near - near[0]) / STEP_S).astype(np.int64), 0, POINTS - 1)
    count = np.bincount(point, minlength=POINTS)
    if not count.max() > 1:
        even: FloatArray = np.interp(times, near, known)
        return even
    total = np.bincount(point, weights=known, minlength=POINTS)
    there = count > 0
    averaged: FloatArray = np.interp(times, times[there], total[there] / count[there])
    return averaged


def directions(paths: FloatArray) -> FloatArray:
    """(D, n) which way each joint came: +1 from below, −1 from above, 0 where nobody knows."""
    sign: FloatArray = np.nan_to_num(-np.sign(paths[:, 0, Q]))
    return sign


def _came_near(t: FloatArray, q: FloatArray, begin: int, rest: float) -> int | None:
    """The first row of the last stay near `rest`; None when it was never farther away."""
    stop = begin
    while stop > 0:
        start = min(stop - 1, int(np.searchsorted(t, t[stop - 1] - _BLOCK_S)))
        away = np.flatnonzero(np.abs(q[start:stop] - rest) > NEAR_RAD)
        if len(away):
            return start + int(away[-1])
        stop = start
    return None
