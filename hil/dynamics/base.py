"""Base parameters: the combinations of inertial parameters that torques can tell apart.

A regressor's columns are linearly dependent, so only φ_b = φ_ind + K φ_dep can be identified
(Gautier 1991, numerical calculation of the base inertial parameters). The rank comes from a
column-pivoted QR. Which columns are kept is decided from left to right, so that the parameters and
their names depend on the robot alone and not on the samples.

How well samples determine them is said by `conditioning`, and by `log_condition` and `neg_log_det`,
smooth functions of the information matrix G = YᵀY of a regressor Y with their gradients.
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
"""Relative to the largest pivot; dependent columns come out below 1e-14, independent ones above
1e-3 for sampled arms."""

SAMPLES = 150

COEFFICIENT_DECIMALS = 12
"""Coefficients are products of two lengths in m: what is beyond is the noise of the samples."""


class Conditioning(NamedTuple):
    """Condition numbers of a regressor.

    Attributes:
        raw: As it stands, mixed units and all.
        scaled: With all columns scaled to length 1.
    """

    raw: float
    scaled: float


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Which columns are kept and how the others fold into them.

    Attributes:
        independent: (b,) indices of the columns kept, ascending.
        dependent: (p − b,) indices of the others, columns of zeros included.
        combination: (b, p − b) K with W[:, dependent] = W[:, independent] K.
        names: (b,) such as `mx_2 + 0.425 m_3`.
    """

    independent: IntArray
    dependent: IntArray
    combination: FloatArray
    names: tuple[str, ...]

    @property
    def rank(self) -> int:
        """Number of base parameters b."""
        return len(self.independent)

    @classmethod
    def from_regressor(cls, W: FloatArray, names: Sequence[str]) -> BaseParameters:
        """The base parameters of a regressor sampled all over the workspace.

        Args:
            W: (M, p) with at least p rows.
            names: Length p.

        Raises:
            FitError: `W` is too short, not finite or zero, or its rank depends on the order of its
                columns: the samples do not excite the robot.
        """
        _require_usable(W, names)
        length = np.linalg.norm(W, axis=0)
        scale = np.where(length > TOLERANCE * length.max(), length, np.inf)
        R = scipy.linalg.qr(W / scale, mode="r")[0][: W.shape[1]]
        rank = int(np.sum(_pivots(R) > TOLERANCE))
        independent = _leftmost(R)
        if len(independent) != rank:
            raise FitError(
                f"the regressor's rank is not clear: {rank} pivoted, {len(independent)} in order",
                hint="sample more of the workspace",
            )
        dependent = np.setdiff1d(np.arange(W.shape[1]), independent)
        K = np.linalg.lstsq(R[:, independent], R[:, dependent], rcond=None)[0]
        K *= np.where(np.isinf(scale), 0.0, scale)[dependent] / scale[independent][:, None]
        K = np.asarray(np.round(K, COEFFICIENT_DECIMALS) + 0.0)
        return cls(independent, dependent, K, _readable(names, independent, dependent, K))

    def reduce(self, W: FloatArray) -> FloatArray:
        """(M, b) columns of the base parameters of a regressor (M, p)."""
        return W[:, self.independent]

    def regressor(
        self, model: RobotModel, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """(N·n, b) the same columns for motions (N, n), without computing the others."""
        return model.regressor(q, qd, qdd, columns=self.independent)

    def combine(self, parameters: FloatArray) -> FloatArray:
        """(b,) base parameters of full ones (p,), so that reduced columns give the same torque."""
        return np.asarray(
            parameters[self.independent] + self.combination @ parameters[self.dependent]
        )

    def expand(self, base: FloatArray) -> FloatArray:
        """(p,) one set of full parameters with these base parameters: the dependent ones are 0."""
        full = np.zeros(len(self.independent) + len(self.dependent))
        full[self.independent] = base
        return full


def _require_usable(W: FloatArray, names: Sequence[str]) -> None:
    if W.ndim != 2 or W.shape[1] != len(names) or len(W) < W.shape[1]:
        raise FitError(f"a regressor of shape {W.shape} cannot tell {len(names)} parameters apart")
    if not np.all(np.isfinite(W)) or not np.any(W):
        raise FitError("the regressor holds NaN or infinity, or nothing but zeros")


def _pivots(R: FloatArray) -> FloatArray:
    pivoted = scipy.linalg.qr(R, mode="r", pivoting=True)[0]
    pivots = np.abs(np.diag(pivoted))
    return np.asarray(pivots / pivots[0])


def _leftmost(R: FloatArray) -> IntArray:
    """Indices of the columns that are independent of those to their left.

    Columns have length 1 or 0; what is left of one after projecting out the basis is its pivot.
    """
    basis = np.zeros((R.shape[0], 0))
    kept = []
    for i, column in enumerate(R.T):
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)  # twice is enough (Kahan)
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
    """Return the base parameters of a robot, from random samples.

    They depend on its joints and gravity alone. They are computed once for all models of an arm,
    as planning, fits and a model read from its file need the same.

    Args:
        model: The robot.
        rotor: Whether rotor inertias count as parameters; never with `gravity_only`.
        gravity_only: Those that act on an arm at rest.
        seed: Of the random samples; the result does not depend on it.
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
    """A robot as far as a regressor's columns are concerned: equal where these are."""

    def __init__(self, model: RobotModel) -> None:
        self.model, self._key = model, model.columns_key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Columns) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def conditioning(W: FloatArray) -> Conditioning:
    """Condition numbers of a regressor (M, p), raw and with its columns scaled to length 1."""
    R = scipy.linalg.qr(W, mode="r", check_finite=False)[0][: W.shape[1]]
    length = np.linalg.norm(R, axis=0)
    if not np.all(length > 0):
        return Conditioning(np.inf, np.inf)
    return Conditioning(float(np.linalg.cond(R)), float(np.linalg.cond(R / length)))


LEAST_SHARE = 1e-15
"""Eigenvalues below this share of the largest are rounding; so is their logarithm."""


class Measure(NamedTuple):
    """A function of the information matrix.

    Attributes:
        value: The smaller, the better the samples identify.
        gradient: (b, b) its derivative, symmetric: dvalue = Σ gradient ∘ dG.
        exact: What `value` stands for: a condition number, or a log determinant.
    """

    value: float
    gradient: FloatArray
    exact: float


def log_condition(G: FloatArray, sharpness: float, scaled: bool = False) -> Measure:
    """Log cond(Y), smooth: where singular values meet, the condition number itself has a kink.

    The largest and the least eigenvalue are replaced by the ends of a p-norm over all,
    (Σ λᵖ)^(1/p) and (Σ λ⁻ᵖ)^(−1/p), which is above log cond by (log b)/p at most.

    Args:
        G: (b, b).
        sharpness: p.
        scaled: Condition number of Y with its columns scaled to length 1.
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
    """−log det(YᵀY)/(2b): how far the axes of the confidence ellipsoid are, in the mean."""
    size = len(G)
    values, V = scipy.linalg.eigh(G, check_finite=False)
    values = np.maximum(values, LEAST_SHARE * values[-1])
    log_det = float(np.log(values).sum())
    return Measure(-0.5 * log_det / size, (V * (-0.5 / size / values)) @ V.T, log_det)
