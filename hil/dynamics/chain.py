"""A serial arm as plain arrays, for recursions over its links that do not go through Pinocchio."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.dynamics.build import JointGeometry

ZERO = 1e-15
"""Sines and metres below this are what is left of an exact zero."""


class Chain(NamedTuple):
    """The constants of n joints.

    The rotation from the frame before joint i into its own is constant + cosine·cos q + sine·sin q.

    Attributes:
        gravity: (3,) in the base frame [m/s²].
        turns: (n,) whether a joint turns about its axis; else it slides along it.
        axis: (n, 3) in the joint's own frame.
        constant: (n, 3, 3).
        cosine: (n, 3, 3).
        sine: (n, 3, 3).
        offset: (n, 3) where the joint's frame is at q = 0, in the frame before [m].
        slide: (n, 3) how that changes with q.
    """

    gravity: FloatArray
    turns: BoolArray
    axis: FloatArray
    constant: FloatArray
    cosine: FloatArray
    sine: FloatArray
    offset: FloatArray
    slide: FloatArray

    @classmethod
    def of(cls, geometry: JointGeometry, gravity: FloatArray) -> Chain:
        """The constants of joints under gravity (3,)."""
        axis, turns = _exact(geometry.axis), np.asarray(geometry.turns)
        fixed, offset = geometry.placement[:, :3, :3], _exact(geometry.placement[:, :3, 3])
        along = np.einsum("ia,ib->iab", axis, axis)
        across = np.array([np.cross(np.eye(3), u) for u in axis])
        # Rodrigues: u uᵀ + (1 − u uᵀ) cos q + [u]× sin q.
        turning = turns[:, None, None]
        constant, cosine, sine = (
            _exact(np.swapaxes(fixed @ part, 1, 2))
            for part in (
                np.where(turning, along, np.eye(3)),
                np.where(turning, np.eye(3) - along, 0.0),
                np.where(turning, across, 0.0),
            )
        )
        slide = np.where(turns[:, None], 0.0, _exact(np.einsum("iab,ib->ia", fixed, axis)))
        down = np.array(gravity, dtype=np.float64)
        return cls(down, turns, axis, constant, cosine, sine, offset, slide)


def _exact(values: FloatArray) -> FloatArray:
    """Without the last bit's noise about 0 and ±1; contiguous."""
    cleaned = np.where(np.abs(values) < ZERO, 0.0, values)
    near_one = np.abs(np.abs(cleaned) - 1) < ZERO
    return np.ascontiguousarray(np.where(near_one, np.sign(cleaned), cleaned))
