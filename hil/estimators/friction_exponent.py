"""Friction that grows like a power of speed: fv·|q̇|^α·sign(q̇) (Han et al. 2020, outer loop)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.core import FloatArray

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
