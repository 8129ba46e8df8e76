"""Outliers among equal robots, after what age and temperature explain is taken out.

A factor on friction (wear, a gearbox that fails) is a difference of logarithms, so values are
compared by their logarithm, joint by joint. Huber's regression takes out what age and temperature
explain, and the median absolute deviation scales the residuals (z). The limit of |z| is simulated
for just this fleet, with its number of robots and joints, its ages and its temperatures: in 99 of
100 fleets of equal robots with normal noise no |z| at all is larger. With heavier tails than the
normal distribution's, more than one fleet of a hundred has an outlier.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.core import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The robots of a fleet compared in one quantity.

    Attributes:
        names: Covariates that the quantity may depend on, such as `age`.
        slopes: (c, n) what a unit of each covariate adds, as a share (0.02 is 2 %).
        errors: (c, n) standard errors of the slopes.
        expected: (R, n) values that the covariates explain.
        z: (R, n) robust z; NaN where a value is missing.
        limit: Above this |z| a robot is an outlier.
        left_out: Covariate → robots that lack it, and so are not compared.
        unused: Covariates that fewer than half of the robots have, and so explain nothing.
    """

    names: tuple[str, ...]
    slopes: FloatArray
    errors: FloatArray
    expected: FloatArray
    z: FloatArray
    limit: float
    left_out: Mapping[str, tuple[int, ...]]
    unused: tuple[str, ...]

    @property
    def outlying(self) -> BoolArray:
        """(R, n) whether a robot is an outlier in a joint."""
        return np.asarray(np.abs(self.z) > self.limit)


FEWEST = 8
"""Fewest robots that are compared: with five robots the scatter estimate rests on the three most
alike."""

FAMILY_WISE = 0.01
"""Probability that a fleet of equal robots has any outlier."""


def compare_robots(values: FloatArray, covariates: Mapping[str, FloatArray]) -> Comparison | None:
    """Return how the robots of a fleet compare; None if there are too few.

    Args:
        values: (R, n) positive, per robot and joint; NaN where not known.
        covariates: By name what the values may depend on, (R,) or (R, n); NaN where not known. A
            covariate that most robots have is taken out, and the others are not compared; one that
            is the same for all robots explains nothing.
    """
    known = np.all(np.isfinite(values) & (values > 0), axis=1)
    wide = {name: np.broadcast_to(_columns(one), values.shape) for name, one in covariates.items()}
    lacking = {name: known & ~np.isfinite(one).all(axis=1) for name, one in wide.items()}
    unused = tuple(name for name, rows in lacking.items() if 0 < known.sum() < 2 * rows.sum())
    left_out = {
        name: tuple(map(int, np.flatnonzero(rows)))
        for name, rows in lacking.items()
        if name not in unused and rows.any()
    }
    for rows in left_out.values():
        known[list(rows)] = False
    if known.sum() < FEWEST or not values.shape[1]:
        return None
    y = np.log(values[known])
    n = y.shape[1]
    wide = {name: one[known] for name, one in wide.items()}
    names = tuple(name for name, one in wide.items() if _varies(one))
    # One covariate, and one more per four further robots: as many parameters as robots would
    # explain every value.
    names = names[: max(0, (len(y) - FEWEST) // 4 + 1)]
    by_joint = [np.array([wide[name][:, j] for name in names]) for j in range(n)]
    fits = [_fit_joint(y[:, j], by_joint[j].reshape(-1, len(y)), j) for j in range(n)]
    slopes, errors, fitted, scores, largest = zip(*fits, strict=True)
    limit = float(np.quantile(np.max(largest, axis=0), 1 - FAMILY_WISE))
    expected, z = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
    expected[known], z[known] = np.exp(np.column_stack(fitted)), np.column_stack(scores)
    return Comparison(
        names, np.column_stack(slopes), np.column_stack(errors), expected, z, limit, left_out,
        tuple(name for name in unused if np.isfinite(covariates[name]).any()),
    )  # fmt: skip


def _columns(one: FloatArray) -> FloatArray:
    return one[:, None] if one.ndim == 1 else one


def _varies(one: FloatArray) -> bool:
    return bool(np.all(np.isfinite(one)) and np.all(np.ptp(one, axis=0) > 0))


def _fit_joint(
    y: FloatArray, covariates: FloatArray, joint: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return slopes, their errors, expected values, z, and the largest |z| per simulated fleet."""
    spread = np.std(covariates, axis=1)
    centred = (covariates.T - covariates.mean(axis=1)) / spread
    X = np.column_stack([np.ones(len(y)), *centred.T])
    beta, scale = huber(X, y[:, None])
    expected = X @ beta[:, 0]
    largest, deviation = _simulated_fleets(X.tobytes(), X.shape, joint)
    errors = deviation[1:] * scale[0] / spread
    return beta[1:, 0] / spread, errors, expected, (y - expected) / scale[0], largest


SIMULATED = 1500
"""Number of simulated fleets of equal robots; each takes about a millisecond."""


@lru_cache(maxsize=64)
def _simulated_fleets(
    content: bytes, shape: tuple[int, int], joint: int
) -> tuple[FloatArray, FloatArray]:
    """Return largest |z| and spread of coefficients of fleets whose robots differ by noise alone.

    Args:
        content: (R, p) columns of the regression as bytes, for the cache.
        shape: Of the columns.
        joint: Seeds the noise.
    """
    X = np.frombuffer(content).reshape(shape)
    noise = np.random.default_rng([20, joint, *shape]).standard_normal((shape[0], SIMULATED))
    beta, scale = huber(X, noise)
    z = np.abs(noise - X @ beta) / scale
    spread: FloatArray = np.std(beta, axis=1)
    largest: FloatArray = np.max(z, axis=0)
    return largest, spread


STEPS = 15
HUBER = 1.345

MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""

LEAST = 1e-12


def huber(X: FloatArray, Y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit many columns at once by Huber's regression, scaled by the median absolute deviation.

    Args:
        X: (R, p) with a column of ones.
        Y: (R, M).

    Returns:
        (p, M) coefficients and (M,) scales.
    """
    beta: FloatArray = np.asarray(np.linalg.lstsq(X, Y)[0], dtype=np.float64)
    for _ in range(STEPS):
        residual = np.abs(Y - X @ beta)
        scale = np.maximum(MAD * np.median(residual, axis=0), LEAST)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(residual, LEAST))
        gram = np.einsum("ri,rm,rj->mij", X, weight, X)
        moment = np.einsum("ri,rm->mi", X, weight * Y)
        beta = np.linalg.solve(gram, moment[:, :, None])[:, :, 0].T
    last: FloatArray = np.maximum(MAD * np.median(np.abs(Y - X @ beta), axis=0), LEAST)
    return beta, last
