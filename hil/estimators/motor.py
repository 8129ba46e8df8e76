"""Motor current and joint torque: eq. 16 of the static paper, both ways.

τ = K₂·i²·sign(i) + K₁·i + K₀ with K₁ > 0 has exactly one current for a torque as long as the torque
grows with the current. With K₂ < 0, a drive that saturates, it stops growing at i = K₁/(2·abs(K₂)),
the turning point; beyond the torque there, τ − K₀ = K₁²/(4·abs(K₂)), no current makes that torque.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, DataError, FloatArray

Constants = FloatArray | float
"""(n,) one number per joint, or the same for all."""


def torque_of(current: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0) -> FloatArray:
    """Joint torque [N·m] of motor currents [A], eq. 16, elementwise with broadcasting."""
    torque: FloatArray = (k2 * np.abs(current) + k1) * current + k0
    return torque


def current_of(torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0) -> FloatArray:
    """Motor current [A] of joint torques [N·m], the inverse of eq. 16 on its growing branch.

    Raises:
        DataError: K₁ is not above 0, or no current makes one of the torques.
    """
    if not np.all(np.asarray(k1) > 0):
        raise DataError(
            "eq. 16 can be solved for the current only with K₁ above 0: torque grows with current",
            hint="a drive whose current counts in the other direction: turn the current's sign",
        )
    beyond = ~has_current(torque, k1, k2, k0)
    if np.any(beyond):
        raise DataError(
            f"no current makes {int(np.sum(beyond))} of {beyond.size} torques by eq. 16: with "
            "K₂ < 0 a drive makes at most K₁²/(4·|K₂|) more than K₀",
            hint="the torques or K₂ are wrong: look at `square` of the model, or fit with square: "
            "zero",
        )
    return nearest_current(torque, k1, k2, k0)


def has_current(torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0) -> BoolArray:
    """Whether there is a current for each torque."""
    found: BoolArray = _discriminant(torque - k0, k1, k2) >= 0.0
    return found


def nearest_current(
    torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0
) -> FloatArray:
    """As `current_of`; for a torque that no current makes, the current at the turning point.

    K₁ must be above 0, which is for the caller to see to.
    """
    rest = np.asarray(torque - k0)
    root = np.sqrt(np.maximum(_discriminant(rest, k1, k2), 0.0))
    # With the sum below the fraction line, K₂ = 0 is no special case and nothing cancels.
    current: FloatArray = 2.0 * rest / (k1 + root)
    with np.errstate(divide="ignore", invalid="ignore"):
        turning = np.copysign(k1 / (2.0 * np.abs(k2)), rest)
    return np.where(has_current(torque, k1, k2, k0), current, turning)


def slope_at(current: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    """Torque per current [N·m/A] at a current; 0 at the turning point."""
    slope: FloatArray = k1 + 2.0 * k2 * np.abs(current)
    return slope


def _discriminant(rest: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    return np.asarray(np.square(k1) + 4.0 * k2 * np.abs(rest))
