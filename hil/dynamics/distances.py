"""Distances between segments, planes and boxes, for many pairs and samples at once.

Points are arrays of shape (3, P, N): coordinate, pair, sample. The coordinate comes first so that
every operation runs over one contiguous block.
"""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray

TINY = 1e-18
"""Stands for a squared length of zero, so that a sphere is a segment whose ends coincide."""

BISECTIONS = 20
"""What is left of a segment 1 m long is a micrometre."""


def segment_distance(p: FloatArray, u: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
    """Distance of the segments p + s u and q + t v, 0 ≤ s, t ≤ 1.

    Closest points of the lines, clamped to one segment, then to the other, then back (Ericson,
    Real-Time Collision Detection, 2005, section 5.1.9).

    Args:
        p: (3, P, N) start of the first segment [m].
        u: (3, P, N) from its start to its end [m].
        q: (3, P, N) start of the second segment [m].
        v: (3, P, N) from its start to its end [m].

    Returns:
        (P, N) [m].
    """
    r = p - q
    uu, vv, uv = dot(u, u) + TINY, dot(v, v) + TINY, dot(u, v)
    ur, vr = dot(u, r), dot(v, r)
    s = _clamp((uv * vr - ur * vv) / (uu * vv - uv * uv + TINY * TINY))
    t = _clamp((uv * s + vr) / vv)
    s = _clamp((uv * t - ur) / uu)
    r += s * u
    r -= t * v
    return np.sqrt(dot(r, r))


def plane_distance(
    p: FloatArray, u: FloatArray, point: FloatArray, normal: FloatArray
) -> FloatArray:
    """(P, N) signed distance [m] of the segments p + s u to a plane; normal (3,) of length 1."""
    start = np.tensordot(normal, p, axes=1) - normal @ point
    return np.asarray(start + np.minimum(np.tensordot(normal, u, axes=1), 0.0))


def box_distance(p: FloatArray, u: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """(P, N) distance [m] of the segments p + s u to a box along the axes; 0 inside.

    The squared distance is convex in s: bisection on the sign of its derivative.
    """
    s_low, s_high = np.zeros(p.shape[1:]), np.ones(p.shape[1:])
    for _ in range(BISECTIONS):
        s = 0.5 * (s_low + s_high)
        rising = dot(_outside(p + s * u, low, high), u) > 0
        s_high = np.where(rising, s, s_high)
        s_low = np.where(rising, s_low, s)
    gap = _outside(p + s_high * u, low, high)
    return np.sqrt(dot(gap, gap))


def dot(x: FloatArray, y: FloatArray) -> FloatArray:
    """(P, N) scalar products."""
    return np.asarray(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])


def _clamp(x: FloatArray) -> FloatArray:
    np.maximum(x, 0.0, out=x)
    return np.minimum(x, 1.0, out=x)


def _outside(x: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Vector from the nearest point of the box to x."""
    return np.asarray(x - np.clip(x, low[:, None, None], high[:, None, None]))
