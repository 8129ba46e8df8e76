"""Detection of outliers among equal robots after removal of the effects of age and temperature.

A factor on friction (from wear or a failing gearbox) appears as a difference of logarithms.
Therefore the logarithms of the values are compared, joint by joint. Huber's regression removes the
effects of age and temperature.
The scores z are the residuals of this regression, scaled by their median absolute deviation. The
limit of |z| is simulated for each fleet, with the number of robots and joints, the ages and the
temperatures of this fleet. In 99 of 100 fleets of equal robots with normal noise, the limit of |z|
is not exceeded. If the noise has heavier tails than the normal distribution, outliers appear in
more than one of a hundred fleets of equal robots.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.core import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Comparison of the robots of a fleet in one quantity, such as friction.

    Attributes:
        names: Covariates on which the quantity may depend, such as `age`.
        slopes: (c, n) relative change of the quantity per unit of each covariate (a slope of 0.02
            is 2 %).
        errors: (c, n) standard errors of the slopes.
        expected: (R, n) values of the quantity that the covariates explain.
        z: (R, n) robust z score of each robot and joint; NaN if a value is missing.
        limit: Limit of |z|; a robot with a larger |z| is an outlier.
        left_out: Mapping of each covariate to the robots that lack this covariate and are therefore
            not compared.
        unused: Names of covariates that are not used, because fewer than half of the robots have
            them.
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
        """Whether each robot is an outlier in each joint, (R, n)."""
        return np.asarray(np.abs(self.z) > self.limit)


FEWEST = 8
"""Minimum number of robots for a comparison: with five robots, the estimate of the scatter would
depend on the three most similar robots.
"""

FAMILY_WISE = 0.01
"""Probability that any robot is an outlier in a fleet of equal robots."""


def compare_robots(values: FloatArray, covariates: Mapping[str, FloatArray]) -> Comparison | None:
    """Return the comparison of the robots of a fleet, or None if there are too few robots.

    Args:
        values: (R, n) positive values of the quantity per robot and joint; NaN if unknown.
        covariates: Values of the covariates by name, (R,) or (R, n); NaN if unknown. If most robots
            have a covariate, its effect is removed, and robots without this covariate are not
            compared. A covariate that is the same for all robots is not used.
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
    # One covariate for the smallest fleet, and one more per four further robots: a fit with as
    # many parameters as robots would explain every value.
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
    """Return slopes, their errors, expected values, z scores, and the simulated largest |z|."""
    spread = np.std(covariates, axis=1)
    centred = (covariates.T - covariates.mean(axis=1)) / spread
    X = np.column_stack([np.ones(len(y)), *centred.T])
    beta, scale = huber(X, y[:, None])
    expected = X @ beta[:, 0]
    largest, deviation = _simulated_fleets(X.tobytes(), X.shape, joint)
    errors = deviation[1:] * scale[0] / spread
    return beta[1:, 0] / spread, errors, expected, (y - expected) / scale[0], largest


SIMULATED = 1500
"""Number of simulated fleets of equal robots; the simulation of a fleet takes about a
millisecond.
"""


@lru_cache(maxsize=64)
def _simulated_fleets(
    content: bytes, shape: tuple[int, int], joint: int
) -> tuple[FloatArray, FloatArray]:
    """Return largest |z| and spread of coefficients of simulated fleets of equal robots.

    Args:
        content: (R, p) columns of the regression, as bytes because they are a key of the cache.
        shape: Shape (R, p) of the columns.
        joint: Index of the joint, used as the seed of the noise.
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
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""

LEAST = 1e-12


def huber(X: FloatArray, Y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit many columns at once by Huber's regression, scaled by the median absolute deviation.

    Args:
        X: (R, p) regressor that contains a column of ones.
        Y: (R, M) observations; each column is fitted separately.

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
