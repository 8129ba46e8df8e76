"""Base parameters: those combinations of inertial parameters that can be identified from torques.

The columns of a regressor are linearly dependent, so only the combinations φ_b = φ_ind + K φ_dep
can be identified (Gautier 1991, numerical calculation of the base inertial parameters). A
column-pivoted QR decomposition of the regressor gives the rank. The independent columns are
selected from left to right; the base parameters and their names therefore depend only on the robot
and not on the samples.

`conditioning`, `log_condition` and `neg_log_det` evaluate how well samples determine the base
parameters. `log_condition` and `neg_log_det` are smooth functions of the information matrix G = YᵀY
of a regressor Y, and also return their gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.linalg

from hil.core import FitError, FloatArray, IntArray
from hil.dynamics.robot_model import RobotModel

TOLERANCE = 1e-9
"""Tolerance for the rank of a regressor, relative to the largest pivot.

For sampled arms, dependent columns have pivots below 1e-14 and independent columns above 1e-3.
"""

SAMPLES = 150

COEFFICIENT_DECIMALS = 12
"""Number of decimals of coefficients, which are products of two lengths in m; further digits are
noise.
"""


class Conditioning(NamedTuple):
    """Condition numbers of a regressor, unscaled and scaled.

    Attributes:
        raw: Condition number of the unscaled regressor, with mixed units.
        scaled: Condition number after scaling all regressor columns to length 1.
    """

    raw: float
    scaled: float


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Independent columns of a regressor, and the combinations that replace the dependent columns.

    Attributes:
        independent: (b,) ascending indices of the independent columns.
        dependent: (p − b,) indices of the dependent columns, which include columns of zeros.
        combination: (b, p − b) matrix K that satisfies W[:, dependent] = W[:, independent] K.
        names: Names of the b base parameters, such as `mx_2 + 0.425 m_3`.
    """

    independent: IntArray
    dependent: IntArray
    combination: FloatArray
    names: tuple[str, ...]

    @property
    def rank(self) -> int:
        """Number b of base parameters."""
        return len(self.independent)

    @classmethod
    def from_regressor(cls, W: FloatArray, names: Sequence[str]) -> BaseParameters:
        """Return the base parameters of a regressor whose samples cover the whole workspace.

        Args:
            W: (M, p) regressor with at least p rows.
            names: p parameter names.

        Raises:
            FitError: `W` is too short, not finite or zero, or its rank depends on the order of its
                columns, because the samples do not excite the robot sufficiently.
        """
        _require_usable(W, names)
        length = np.linalg.norm(W, axis=0)
        scale = np.where(length > TOLERANCE * length.max(), length, np.inf)
        R = scipy.linalg.qr(W / scale, mode="r")[0][: W.shape[1]]
        rank = int(np.sum(_pivots(R) > TOLERANCE))
        independent = _leftmost(R)
        if len(independent) != rank:
            raise FitError(
                f"the rank of the regressor is ambiguous: {rank} with pivoting, "
                f"{len(independent)} without",
                hint="use samples from more of the workspace",
            )
        dependent = np.setdiff1d(np.arange(W.shape[1]), independent)
        K = np.linalg.lstsq(R[:, independent], R[:, dependent], rcond=None)[0]
        K *= np.where(np.isinf(scale), 0.0, scale)[dependent] / scale[independent][:, None]
        K = np.asarray(np.round(K, COEFFICIENT_DECIMALS) + 0.0)
        return cls(independent, dependent, K, _readable(names, independent, dependent, K))

    def reduce(self, W: FloatArray) -> FloatArray:
        """Return those columns (M, b) of a regressor (M, p) that belong to base parameters."""
        return W[:, self.independent]

    def regressor(
        self, model: RobotModel, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """Return the regressor columns (N·n, b) of the base parameters for motions (N, n).

        Other columns of the regressor are not computed.
        """
        return model.regressor(q, qd, qdd, columns=self.independent)

    def combine(self, parameters: FloatArray) -> FloatArray:
        """Return the base parameters (b,) that give the same torque as the full parameters (p,)."""
        return np.asarray(
            parameters[self.independent] + self.combination @ parameters[self.dependent]
        )

    def expand(self, base: FloatArray) -> FloatArray:
        """Return full parameters (p,) with these base parameters; dependent parameters are 0."""
        full = np.zeros(len(self.independent) + len(self.dependent))
        full[self.independent] = base
        return full


def _require_usable(W: FloatArray, names: Sequence[str]) -> None:
    if W.ndim != 2 or W.shape[1] != len(names) or len(W) < W.shape[1]:
        raise FitError(f"a regressor of shape {W.shape} cannot determine {len(names)} parameters")
    if not np.all(np.isfinite(W)) or not np.any(W):
        raise FitError("the regressor contains NaN or infinite values, or only zeros")


def _pivots(R: FloatArray) -> FloatArray:
    pivoted = scipy.linalg.qr(R, mode="r", pivoting=True)[0]
    pivots = np.abs(np.diag(pivoted))
    return np.asarray(pivots / pivots[0])


def _leftmost(R: FloatArray) -> IntArray:
    """Return the indices of the columns that are linearly independent of all columns to their left.

    The columns of `R` must have length 1 or 0. The pivot of a column is its length after projection
    onto the complement of the basis.
    """
    basis = np.zeros((R.shape[0], 0))
    kept = []
    for i, column in enumerate(R.T):
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)  # a second orthogonalisation is sufficient (Kahan)
        size = np.linalg.norm(rest)
        if size > TOLERANCE:
            kept.append(i)
            basis = np.column_stack([basis, rest / size])
    return np.array(kept, dtype=np.int64)


def _readable(
    names: Sequence[str], independent: IntArray, dependent: IntArray, K: FloatArray
) -> tuple[str, ...]:
    return tuple(
        names[i] + "".join(_term(k, names[j]) for k, j in zip(row, dependent, strict=True) if k)
        for i, row in zip(independent, K, strict=True)
    )


def _term(coefficient: float, name: str) -> str:
    sign, size = ("-" if coefficient < 0 else "+"), f"{abs(coefficient):.6g}"
    return f" {sign} {name}" if size == "1" else f" {sign} {size} {name}"


def base_parameters(
    model: RobotModel, *, rotor: bool = True, gravity_only: bool = False, seed: int = 0
) -> BaseParameters:
    """Return the base parameters of a robot, computed from random samples.

    The base parameters depend only on the joints and on gravity. The base parameters are cached for
    all models of an arm, because planning, fits and stored models need the same base parameters.

    Args:
        model: Robot model.
        rotor: Flag; if true, rotor inertias are included. The flag `rotor` is ignored with
            `gravity_only`.
        gravity_only: Flag; if true, only parameters that act on a static arm are included.
        seed: Seed of the random samples; the base parameters do not depend on it.
    """
    return _sampled(_Columns(model), rotor, gravity_only, seed)


@lru_cache(maxsize=32)
def _sampled(columns: _Columns, rotor: bool, gravity_only: bool, seed: int) -> BaseParameters:
    model, random = columns.model, np.random.default_rng(seed)
    q, qd, qdd = random.uniform(-np.pi, np.pi, (3, SAMPLES, model.n))
    if gravity_only:
        names = model.parameter_names(rotor=False)
        base = BaseParameters.from_regressor(model.gravity_regressor(q), names)
    else:
        W = model.regressor(q, qd, qdd, rotor=rotor)
        base = BaseParameters.from_regressor(W, model.parameter_names(rotor=rotor))
    for shared in (base.independent, base.dependent, base.combination):
        shared.flags.writeable = False
    return base


class _Columns:
    """Hashable key of a robot, equal for all robots with equal regressor columns."""

    def __init__(self, model: RobotModel) -> None:
        self.model, self._key = model, model.columns_key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Columns) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def conditioning(W: FloatArray) -> Conditioning:
    """Return the condition numbers of a regressor (M, p), unscaled and with columns of length 1."""
    R = scipy.linalg.qr(W, mode="r", check_finite=False)[0][: W.shape[1]]
    length = np.linalg.norm(R, axis=0)
    if not np.all(length > 0):
        return Conditioning(np.inf, np.inf)
    return Conditioning(float(np.linalg.cond(R)), float(np.linalg.cond(R / length)))


LEAST_SHARE = 1e-15
"""Share of the largest eigenvalue below which an eigenvalue is treated as a rounding error."""


class Measure(NamedTuple):
    """Value of a function of the information matrix, with its gradient.

    Attributes:
        value: Value of the function; smaller values mean that the samples identify the parameters
            better.
        gradient: (b, b) symmetric derivative of `value`: dvalue = Σ gradient ∘ dG.
        exact: Exact quantity that `value` approximates: a condition number, or a log determinant.
    """

    value: float
    gradient: FloatArray
    exact: float


def log_condition(G: FloatArray, sharpness: float, scaled: bool = False) -> Measure:
    """Return a smooth approximation of log cond(Y), which has kinks at equal singular values.

    In the approximation, p-norms over all eigenvalues replace the largest and the smallest
    eigenvalue: (Σ λᵖ)^(1/p) and (Σ λ⁻ᵖ)^(−1/p). The approximation exceeds log cond by at most (log
    b)/p.

    Args:
        G: (b, b) information matrix.
        sharpness: Exponent p.
        scaled: Flag; if true, the columns of Y are scaled to length 1.
    """
    if scaled:
        return _scaled(G, sharpness)
    values, V = scipy.linalg.eigh(G, check_finite=False)
    logs = np.log(np.maximum(values, LEAST_SHARE * values[-1]))
    high, low = np.exp(sharpness * (logs - logs[-1])), np.exp(sharpness * (logs[0] - logs))
    spread = logs[-1] - logs[0]
    value = 0.5 * (spread + np.log(high.sum() * low.sum()) / sharpness)
    by_values = 0.5 * (high / high.sum() - low / low.sum()) * np.exp(-logs)
    return Measure(float(value), (V * by_values) @ V.T, float(np.exp(0.5 * spread)))


def _scaled(G: FloatArray, sharpness: float) -> Measure:
    length = np.sqrt(np.maximum(np.diag(G), LEAST_SHARE * np.diag(G).max()))
    shape = G / np.outer(length, length)
    value, by_shape, exact = log_condition(shape, sharpness)
    by_length = np.einsum("ij,ij->i", by_shape, shape) / length**2
    gradient = by_shape / np.outer(length, length) - np.diag(by_length)
    return Measure(value, gradient, exact)


def neg_log_det(G: FloatArray) -> Measure:
    """Return −log det(YᵀY)/(2b), the mean logarithm of the confidence ellipsoid's axes."""
    size = len(G)
    values, V = scipy.linalg.eigh(G, check_finite=False)
    values = np.maximum(values, LEAST_SHARE * values[-1])
    log_det = float(np.log(values).sum())
    return Measure(-0.5 * log_det / size, (V * (-0.5 / size / values)) @ V.T, log_det)
