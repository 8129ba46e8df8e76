"""The curve of a drive, torque over motor current: eq. 16 of the static paper.

τ = K₂·i²·sign(i) + K₁·i + K₀ with K₁ > 0 has exactly one current for a torque as long as the torque
grows with the current. With K₂ < 0, a drive that saturates, it stops growing at i = K₁/(2·abs(K₂)),
the turning point; beyond the torque there, τ − K₀ = K₁²/(4·abs(K₂)), no current makes that torque.

`fit_currents` identifies gravity and the curve together, with K₁ given, by least squares on the
predicted current i = f⁻¹(X·β + τ_load; K₁, K₂). X holds the offset, which is −K₀.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray
from hil.estimators.covariance import Clustered, ClusterSums, clustered_covariance
from hil.estimators.least_squares import weighted_least_squares

Constants = FloatArray | float
"""(n,) one number per joint, or the same for all."""


def has_current(torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0) -> BoolArray:
    """Whether there is a current for each torque."""
    return np.asarray(_discriminant(torque - k0, k1, k2) >= 0.0)


def nearest_current(
    torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0
) -> FloatArray:
    """Motor current [A] of joint torques [N·m], the inverse of eq. 16 on its growing branch.

    Elementwise with broadcasting; for a torque that no current makes, the current at the turning
    point. K₁ must be above 0, which is for the caller to see to.
    """
    rest = np.asarray(torque - k0)
    root = np.sqrt(np.maximum(_discriminant(rest, k1, k2), 0.0))
    # With the sum below the fraction line, K₂ = 0 is no special case and nothing cancels.
    current: FloatArray = 2.0 * rest / (k1 + root)
    with np.errstate(divide="ignore", invalid="ignore"):
        turning = np.copysign(k1 / (2.0 * np.abs(k2)), rest)
    return np.where(has_current(torque, k1, k2, k0), current, turning)


def _discriminant(rest: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    return np.asarray(np.square(k1) + 4.0 * k2 * np.abs(rest))


def slope_at(current: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    """Torque per current [N·m/A] at a current; 0 at the turning point."""
    slope: FloatArray = k1 + 2.0 * k2 * np.abs(current)
    return slope


VISIBLE = 0.1
"""Share of K₁; at a drive's largest current K₂·i is a few percent of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Currents:
    """One regression: currents at rest and what they hold.

    Attributes:
        X: (N, p) regressor of the torque [N·m], offsets included.
        load: (N,) torque of the declared load [N·m].
        current: (N,) measured [A].
        k1: (N,) K₁ of the row's joint [N·m/A].
        joint: (N,) joint of each row.
        pose: (N,) pose of each row, what is clustered.
        weight: (N,).
    """

    X: FloatArray
    load: FloatArray
    current: FloatArray
    k1: FloatArray
    joint: IntArray
    pose: IntArray
    weight: FloatArray


class CurrentFit(NamedTuple):
    """Where the error of the predicted current is least.

    Attributes:
        coefficients: (p,) torque [N·m] per column of X.
        squares: (k,) K₂ [N·m/A²] of the joints asked for.
        clustered: Covariance (p + k, p + k), the coefficients first, and degrees of freedom.
        residual: (N,) measured less predicted current [A].
        rank, condition: Of the Jacobian, columns scaled.
        jacobian: (N, p + k) of the predicted current.
    """

    coefficients: FloatArray
    squares: FloatArray
    clustered: Clustered
    residual: FloatArray
    rank: int
    condition: float
    jacobian: FloatArray


def fit_currents(data: Currents, squares: list[int]) -> CurrentFit:
    """Least squares on the predicted current.

    Args:
        data: The rows.
        squares: Joints whose K₂ is estimated; it is 0 for the others.

    Raises:
        FitError: It does not settle.
    """
    theta = _settled(data, squares)
    J, residual = _linearised(data, theta, squares)
    step = weighted_least_squares(J, residual, data.weight)
    sums = ClusterSums.of(J, residual, data.weight, data.pose)
    clustered = clustered_covariance(step.bread, sums)
    p = data.X.shape[1]
    return CurrentFit(theta[:p], theta[p:], clustered, residual, step.rank, step.condition, J)


def _settled(data: Currents, squares: list[int]) -> FloatArray:
    """Coefficients (p,) and K₂ (k,) at which the error is least."""
    torque = data.k1 * data.current - data.load
    straight = weighted_least_squares(data.X, torque, data.weight / data.k1**2).coefficients
    if not squares:  # the current of a drive that does not bend is linear in them
        return straight
    from scipy.optimize import least_squares

    root = np.sqrt(data.weight)
    minimum = least_squares(
        lambda theta: root * (data.current - _predicted(data, theta, squares)[0]),
        np.append(straight, np.zeros(len(squares))),
        lambda theta: -root[:, None] * _linearised(data, theta, squares)[0],
        x_scale="jac",
        # As far as rounding allows: the covariance takes the gradient for zero.
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    )
    if not (minimum.success and np.all(_predicted(data, minimum.x, squares)[1])):
        raise FitError(
            "the drive's curve (K₂ of eq. 16) did not settle: the data tell too little about it",
            hint="fit with square: zero, or record poses with larger gravity torques",
        )
    return np.asarray(minimum.x)


def _predicted(
    data: Currents, theta: FloatArray, squares: list[int]
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Current of each row, whether there is one for its torque, and its slope, each (N,)."""
    p = data.X.shape[1]
    k2 = np.zeros(len(data.current))
    for number, joint in enumerate(squares):
        k2[data.joint == joint] = theta[p + number]
    torque = data.X @ theta[:p] + data.load
    current = nearest_current(torque, data.k1, k2)
    return current, has_current(torque, data.k1, k2), slope_at(current, data.k1, k2)


def _linearised(
    data: Currents, theta: FloatArray, squares: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Jacobian (N, p + k) of the predicted current, and the residual (N,)."""
    current, exists, slope = _predicted(data, theta, squares)
    own = data.joint[:, None] == np.array(squares, dtype=np.int64)
    by_k2 = np.where(own, -(current * np.abs(current))[:, None], 0.0)
    # Beyond the turning point the current stays where it is, whatever the torque.
    per_torque = np.divide(1.0, slope, out=np.zeros_like(slope), where=exists & (slope > 0.0))
    J: FloatArray = np.hstack([data.X, by_k2]) * per_torque[:, None]
    return J, data.current - current


def linear_residual(data: Currents) -> FloatArray:
    """(N,) error of the currents of a drive that does not bend."""
    return _linearised(data, _settled(data, []), [])[1]


def visible_squares(data: Currents, joints: list[int]) -> list[int]:
    """Those of the joints whose K₂ the data could show if the drive bent strongly.

    To first order about a linear drive: the standard error of K₂·i at the joint's largest current
    must be below `VISIBLE` of K₁. With less, the curve is fitted to friction.
    """
    theta = np.append(_settled(data, []), 0.0) if joints else np.empty(0)
    return [joint for joint in joints if _is_visible(data, theta, joint)]


def _is_visible(data: Currents, theta: FloatArray, joint: int) -> bool:
    J, residual = _linearised(data, theta, [joint])
    step = weighted_least_squares(J, residual, data.weight)
    sums = ClusterSums.of(J, residual - J @ step.coefficients, data.weight, data.pose)
    error = np.sqrt(clustered_covariance(step.bread, sums, "CR1").covariance[-1, -1])
    rows = data.joint == joint
    largest = float(np.max(np.abs(data.current[rows])))
    determined = step.rank == len(theta)
    return bool(determined and error * largest < VISIBLE * data.k1[rows][0])
