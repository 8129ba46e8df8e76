"""Friction of joints as curves over velocity, for models whose friction has no memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hil.core import BoolArray, FloatArray

COULOMB, STATIC, VISCOUS, OFFSET = "coulomb", "static", "viscous", "offset"
"""Terms that pages tell apart; where there is a `static` one, friction begins with it."""


@dataclass(frozen=True, slots=True, eq=False)
class FrictionCurve:
    """Friction at velocities (N, n), each array (N, n) [N·m].

    Attributes:
        torque: All of it.
        dry: The same without the viscous part: Coulomb, Stribeck and offset.
        std_error: Standard error of `torque`, at most: those of the coefficients added up, for
            models keep no correlation between them; NaN where they are not known.
        terms: Names of what it is the sum of.
    """

    torque: FloatArray
    dry: FloatArray
    std_error: FloatArray
    terms: tuple[str, ...]


@runtime_checkable
class HasFrictionCurve(Protocol):
    """What a model also offers when its friction may be a function of velocity."""

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Friction at velocities (N, n) [rad/s]; None when it depends on more than that."""


def curve_of(
    terms: Sequence[str], columns: FloatArray, values: FloatArray, errors: FloatArray
) -> FrictionCurve:
    """A curve that is linear in coefficients.

    Args:
        terms: Names of the k columns.
        columns: (N, n, k) at the velocities.
        values: (n, k) coefficients of every joint.
        errors: (n, k) their standard errors.
    """
    parts = columns * values
    dry: BoolArray = np.array([term != VISCOUS for term in terms])
    bound = np.sum(np.abs(columns) * errors, axis=-1)
    return FrictionCurve(parts.sum(axis=-1), parts[..., dry].sum(axis=-1), bound, tuple(terms))
