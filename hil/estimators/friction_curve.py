"""Friction of joints as a curve over velocity, for models whose friction has no memory.

`FrictionCurve` is what such a model reports of its friction. `power_of_speed` is a law with a
parameter that is not linear, fv·|q̇|^α·sign(q̇) (Han et al. 2020); `best_exponent` searches for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


LOWEST, HIGHEST = 0.2, 1.6
"""Exponents that are looked at: below, the power is Coulomb friction by another name."""


def power_of_speed(qd: FloatArray, exponent: FloatArray | float, width: float) -> FloatArray:
    """q̇ (q̇² + width²)^((α − 1)/2): sign(q̇)·|q̇|^α beyond `width`, linear and smooth within.

    Args:
        qd: (…, n) [rad/s].
        exponent: (n,) α; 1 gives q̇ itself.
        width: [rad/s], above 0; the power's slope at 0 would be infinite.
    """
    return np.asarray(qd * (qd**2 + width**2) ** (0.5 * (np.asarray(exponent) - 1.0)))


def best_exponent(
    rest: FloatArray,
    others: FloatArray,
    power: Callable[[float], FloatArray],
    weight: FloatArray,
    start: float,
) -> float:
    """The exponent with which one joint's friction columns explain most.

    Args:
        rest: (N,) torque less what rigid bodies explain.
        others: (N, k) friction columns that do not depend on the exponent.
        power: α → (N,) column.
        weight: (N,).
        start: The exponent so far; kept where the search finds nothing better.
    """
    from scipy.optimize import minimize_scalar

    root = np.sqrt(weight)
    fixed, target = others * root[:, None], rest * root

    def left(exponent: float) -> float:
        X = np.column_stack([fixed, power(exponent) * root])
        solution = np.linalg.lstsq(X, target, rcond=None)[0]
        return float(np.sum((target - X @ solution) ** 2))

    found = minimize_scalar(left, bounds=(LOWEST, HIGHEST), options={"xatol": 1e-3})
    return float(found.x) if found.fun < left(start) else start
