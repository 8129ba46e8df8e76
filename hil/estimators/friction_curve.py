"""Friction as a curve over velocity, for models whose friction has no memory.

`FrictionCurve` is the friction curve of a model whose friction has no memory. `power_of_speed` is
the nonlinear law fv·|q̇|^α·sign(q̇) (Han et al. 2020), and `best_exponent` fits its exponent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hil.core import BoolArray, FloatArray

COULOMB, STATIC, VISCOUS, OFFSET = "coulomb", "static", "viscous", "offset"
"""Names of the friction terms on pages; a law with a `static` term starts at this term."""


@dataclass(frozen=True, slots=True, eq=False)
class FrictionCurve:
    """Friction torques at velocities (N, n), each array (N, n) [N·m].

    Attributes:
        torque: Total friction.
        dry: Friction torque without the viscous part: Coulomb, Stribeck and offset terms.
        std_error: Upper bound of the standard error of `torque`: the sum of the standard errors of
            all terms, because models store no correlation between them; NaN if unknown.
        terms: Names of the terms whose sum is the friction torque.
    """

    torque: FloatArray
    dry: FloatArray
    std_error: FloatArray
    terms: tuple[str, ...]


@runtime_checkable
class HasFrictionCurve(Protocol):
    """Interface of models whose friction can be a function of velocity alone."""

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return the friction at velocities (N, n) [rad/s]; None if it has other inputs too."""


def curve_of(
    terms: Sequence[str], columns: FloatArray, values: FloatArray, errors: FloatArray
) -> FrictionCurve:
    """Return a friction curve that is linear in its coefficients.

    Args:
        terms: Names of the k friction columns.
        columns: (N, n, k) friction columns at the velocities.
        values: (n, k) coefficients of the columns for every joint.
        errors: (n, k) standard errors of the coefficients.
    """
    parts = columns * values
    dry: BoolArray = np.array([term != VISCOUS for term in terms])
    bound = np.sum(np.abs(columns) * errors, axis=-1)
    return FrictionCurve(parts.sum(axis=-1), parts[..., dry].sum(axis=-1), bound, tuple(terms))


LOWEST, HIGHEST = 0.2, 1.6
"""Smallest and largest exponent in the search.

With an exponent below the smallest, the power law is nearly equal to Coulomb friction.
"""


def power_of_speed(qd: FloatArray, exponent: FloatArray | float, width: float) -> FloatArray:
    """Return q̇ (q̇² + width²)^((α − 1)/2), a smooth form of sign(q̇)·|q̇|^α.

    The smooth function is close to the power law beyond `width` and linear within `width`.

    Args:
        qd: (…, n) velocities [rad/s].
        exponent: (n,) α; 1 gives q̇ itself.
        width: Smoothing width [rad/s], above 0, because the slope of the power law at 0 is
            infinite.
    """
    return np.asarray(qd * (qd**2 + width**2) ** (0.5 * (np.asarray(exponent) - 1.0)))


def best_exponent(
    rest: FloatArray,
    others: FloatArray,
    power: Callable[[float], FloatArray],
    weight: FloatArray,
    start: float,
) -> float:
    """Return the exponent whose friction columns explain most of the torque of one joint.

    Args:
        rest: (N,) torque that the rigid body does not explain.
        others: (N, k) friction columns that do not depend on the exponent.
        power: Function from the exponent α to a friction column (N,).
        weight: (N,) weights of the samples.
        start: Initial exponent, which is returned if the search finds no better value.
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
