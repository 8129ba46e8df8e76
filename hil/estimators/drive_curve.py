"""Torque of a drive as a function of its motor current: eq. 16 of the static paper.

τ = K₂·i²·sign(i) + K₁·i + K₀ with K₁ > 0 has exactly one current for each torque as long as the
torque increases with the current. For K₂ < 0 (a saturating drive), the torque stops increasing at
the turning point i = K₁/(2·abs(K₂)). No current produces a torque beyond τ − K₀ = K₁²/(4·abs(K₂)).

`fit_currents` fits gravity and curve together for a given K₁, by least squares on the predicted
current i = f⁻¹(X·β + τ_load; K₁, K₂). The regressor X includes the offset column, whose coefficient
is −K₀.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray
from hil.estimators.covariance import Clustered, ClusterSums, clustered_covariance
from hil.estimators.least_squares import weighted_least_squares

Constants = FloatArray | float
"""Constant with one value per joint (n,), or with one value for all joints."""


def has_current(torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0) -> BoolArray:
    """Return whether some motor current produces each torque."""
    return np.asarray(_discriminant(torque - k0, k1, k2) >= 0.0)


def nearest_current(
    torque: FloatArray, k1: Constants, k2: Constants, k0: Constants = 0.0
) -> FloatArray:
    """Return the motor current [A] of joint torques [N·m]: the inverse of eq. 16.

    The inverse uses the increasing branch of the curve, computed elementwise with broadcasting. For
    a torque that no current produces, the result is the current at the turning point. The caller
    must ensure that K₁ is positive.
    """
    rest = np.asarray(torque - k0)
    root = np.sqrt(np.maximum(_discriminant(rest, k1, k2), 0.0))
    # The sum in the denominator also works for K₂ = 0 and avoids cancellation.
    current: FloatArray = 2.0 * rest / (k1 + root)
    with np.errstate(divide="ignore", invalid="ignore"):
        turning = np.copysign(k1 / (2.0 * np.abs(k2)), rest)
    return np.where(has_current(torque, k1, k2, k0), current, turning)


def _discriminant(rest: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    return np.asarray(np.square(k1) + 4.0 * k2 * np.abs(rest))


def slope_at(current: FloatArray, k1: Constants, k2: Constants) -> FloatArray:
    """Return the torque per current [N·m/A] at a current; 0 at the turning point."""
    slope: FloatArray = k1 + 2.0 * k2 * np.abs(current)
    return slope


VISIBLE = 0.1
"""Maximum standard error of K₂·i at the largest current, as a share of K₁, for K₂ to be estimated.

For real drives, K₂·i at the largest current is a few percent of K₁.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Currents:
    """Data of one regression: static currents and the torques that these currents hold.

    Attributes:
        X: (N, p) regressor of the torque [N·m], including offsets.
        load: (N,) torque of the declared payload [N·m].
        current: (N,) measured currents [A].
        k1: (N,) constant K₁ [N·m/A] of the joint to which each row belongs.
        joint: (N,) index of the joint to which each row belongs.
        pose: (N,) index of the pose of each row; the errors of one pose form a cluster.
        weight: (N,) weights of the rows.
    """

    X: FloatArray
    load: FloatArray
    current: FloatArray
    k1: FloatArray
    joint: IntArray
    pose: IntArray
    weight: FloatArray


class CurrentFit(NamedTuple):
    """Least-squares solution for the predicted current.

    Attributes:
        coefficients: (p,) torque [N·m] per unit of each column of X.
        squares: (k,) constant K₂ [N·m/A²] of each requested joint.
        clustered: Covariance (p + k, p + k) of coefficients and squares, and degrees of freedom.
        residual: (N,) measured minus predicted current [A].
        rank, condition: Rank and condition number of the column-scaled Jacobian.
        jacobian: (N, p + k) Jacobian of the predicted current.
    """

    coefficients: FloatArray
    squares: FloatArray
    clustered: Clustered
    residual: FloatArray
    rank: int
    condition: float
    jacobian: FloatArray


def fit_currents(data: Currents, squares: list[int]) -> CurrentFit:
    """Return the least-squares solution for the predicted current.

    Args:
        data: Rows of the regression.
        squares: Joints whose K₂ is estimated; K₂ of all other joints is 0.

    Raises:
        FitError: The iteration of the fit does not converge.
    """
    theta = _settled(data, squares)
    J, residual = _linearised(data, theta, squares)
    step = weighted_least_squares(J, residual, data.weight)
    sums = ClusterSums.of(J, residual, data.weight, data.pose)
    clustered = clustered_covariance(step.bread, sums)
    p = data.X.shape[1]
    return CurrentFit(theta[:p], theta[p:], clustered, residual, step.rank, step.condition, J)


def _settled(data: Currents, squares: list[int]) -> FloatArray:
    """Return the coefficients (p,) and K₂ (k,) with the smallest error of the predicted current."""
    torque = data.k1 * data.current - data.load
    straight = weighted_least_squares(data.X, torque, data.weight / data.k1**2).coefficients
    if not squares:  # the current of a linear drive is linear in the coefficients
        return straight
    from scipy.optimize import least_squares

    root = np.sqrt(data.weight)
    minimum = least_squares(
        lambda theta: root * (data.current - _predicted(data, theta, squares)[0]),
        np.append(straight, np.zeros(len(squares))),
        lambda theta: -root[:, None] * _linearised(data, theta, squares)[0],
        x_scale="jac",
        # The tolerances are minimal, because the covariance assumes a gradient of zero.
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    )
    if not (minimum.success and np.all(_predicted(data, minimum.x, squares)[1])):
        raise FitError(
            "the drive curve (K₂ of eq. 16) did not converge: the data hardly determine it",
            hint="fit with square: zero, or record poses with larger gravity torques",
        )
    return np.asarray(minimum.x)


def _predicted(
    data: Currents, theta: FloatArray, squares: list[int]
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return predicted current, whether this current exists, and slope of each row, all (N,)."""
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
    """Return the Jacobian (N, p + k) of the predicted current, and the residual (N,)."""
    current, exists, slope = _predicted(data, theta, squares)
    own = data.joint[:, None] == np.array(squares, dtype=np.int64)
    by_k2 = np.where(own, -(current * np.abs(current))[:, None], 0.0)
    # Beyond the turning point, the predicted current is constant.
    per_torque = np.divide(1.0, slope, out=np.zeros_like(slope), where=exists & (slope > 0.0))
    J: FloatArray = np.hstack([data.X, by_k2]) * per_torque[:, None]
    return J, data.current - current


def linear_residual(data: Currents) -> FloatArray:
    """Return (N,) the current error of a linear drive."""
    return _linearised(data, _settled(data, []), [])[1]


def visible_squares(data: Currents, joints: list[int]) -> list[int]:
    """Return the joints for which the data could show a strong curvature K₂.

    The visibility test is of first order about a linear drive: the standard error of K₂·i at the
    largest current of the joint must be below `VISIBLE` times K₁. If the standard error of K₂·i
    were larger, a fitted curve would describe friction.
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
