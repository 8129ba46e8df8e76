"""A serial arm as numbers for batches: what turns vectors from one joint's frame to the next.

Arrays are component-major, (component, vector, sample), so that one NumPy call acts on one
component of many vectors at all samples of a chunk, in memory that is contiguous. Constants of
the geometry that are zero, most of them for arms in DH convention, cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.dynamics.build import JointGeometry
from hil.typing import FloatArray

ZERO = 1e-15
"""Cosines and metres below this are what is left of an exact zero."""

Rotation = list[list[tuple[int, Any]]]
"""Per row of a rotation matrix: its columns that are not zero, and their values (C,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """One joint and the constant placement before it.

    Attributes:
        turns: Whether it turns about its axis; else it slides along it.
        axis: (3,) in its own frame.
        constant, cosine, sine: (3, 3) the rotation from the frame before into its own is
            constant + cosine·cos q + sine·sin q.
        offset: (3,) where its frame is at q = 0, in the frame before [m].
        slide: (3,) how that changes with q.
    """

    turns: bool
    axis: FloatArray
    constant: FloatArray
    cosine: FloatArray
    sine: FloatArray
    offset: FloatArray
    slide: FloatArray

    def rotation(self, cos: FloatArray, sin: FloatArray) -> Rotation:
        """From the frame before into the joint's own, at angles of these cosines, sines (C,)."""
        return [
            [(k, self._entry(i, k, cos, sin)) for k in range(3) if self._matters(i, k)]
            for i in range(3)
        ]

    def displacement(self, q: FloatArray) -> list[tuple[int, Any]]:
        """The components of the joint's place in the frame before that are not zero."""
        return [
            (k, self.offset[k] + self.slide[k] * q if self.slide[k] else self.offset[k])
            for k in range(3)
            if self.offset[k] or self.slide[k]
        ]

    def _matters(self, i: int, k: int) -> bool:
        return bool(self.constant[i, k] or self.cosine[i, k] or self.sine[i, k])

    def _entry(self, i: int, k: int, cos: FloatArray, sin: FloatArray) -> Any:
        parts = (self.constant[i, k], _times(self.cosine[i, k], cos), _times(self.sine[i, k], sin))
        present = [part for part in parts if not np.isscalar(part) or part]
        return sum(present[1:], start=present[0])


def joints_of(geometry: JointGeometry) -> tuple[Joint, ...]:
    """The joints of a chain."""
    parts = zip(geometry.placement, geometry.axis, geometry.turns, strict=True)
    return tuple(_joint(place, axis, bool(turns)) for place, axis, turns in parts)


def _joint(placement: FloatArray, axis: FloatArray, turns: bool) -> Joint:
    fixed, nothing = placement[:3, :3], np.zeros((3, 3))
    along, across = np.outer(axis, axis), np.cross(np.eye(3), axis)
    # Rodrigues: u uᵀ + (1 − u uᵀ) cos q + [u]× sin q.
    rotation = (along, np.eye(3) - along, across) if turns else (np.eye(3), nothing, nothing)
    constant, cosine, sine = (_exact((fixed @ part).T) for part in rotation)
    slide = np.zeros(3) if turns else _exact(fixed @ axis)
    offset = _exact(placement[:3, 3])
    return Joint(turns, _exact(axis), constant, cosine, sine, offset, slide)


def rotate(rotation: Rotation, given: FloatArray, out: FloatArray, scratch: FloatArray) -> None:
    """Turn vectors (3, k, C) into `out`; `scratch` is (k, C)."""
    for terms, target in zip(rotation, out, strict=True):
        for place, (k, value) in enumerate(terms):
            np.multiply(given[k], value, out=scratch if place else target)
            if place:
                target += scratch


def transposed(rotation: Rotation) -> Rotation:
    """The inverse of a rotation."""
    rows: Rotation = [[], [], []]
    for i, terms in enumerate(rotation):
        for k, value in terms:
            rows[k].append((i, value))
    return rows


def add_cross(
    given: FloatArray,
    place: Sequence[tuple[int, Any]],
    out: FloatArray,
    scratch: FloatArray,
) -> None:
    """Add vectors (3, k, C) × place to `out`; `scratch` is (k, C)."""
    for m, value in place:
        np.multiply(given[(m + 2) % 3], value, out=scratch)
        out[(m + 1) % 3] += scratch
        np.multiply(given[(m + 1) % 3], value, out=scratch)
        out[(m + 2) % 3] -= scratch


def _times(factor: float, values: FloatArray) -> Any:
    if factor == 0:
        return 0.0
    return values if factor == 1 else factor * values


def _exact(values: FloatArray) -> FloatArray:
    """Without the last bit's noise about 0 and ±1."""
    cleaned = np.where(np.abs(values) < ZERO, 0.0, values)
    return np.where(np.abs(np.abs(cleaned) - 1) < ZERO, np.sign(cleaned), cleaned)
