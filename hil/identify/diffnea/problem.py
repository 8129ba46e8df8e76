"""The least-squares problem: weighted torque residuals and a weak pull towards the nominal arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.identify.compress import JointwiseQR, upper_triangle
from hil.identify.diffnea.minimise import Minimum, minimise
from hil.identify.diffnea.unknowns import Unknowns
from hil.identify.jointwise import Solution, System
from hil.typing import FloatArray

Observed = Callable[[FloatArray], System]
"""Values → an equivalent small system whose columns are those of the values, slopes included."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Σⱼ |rⱼ|²/σⱼ² + prior · (number of samples) · divergence from nominal.

    Attributes:
        unknowns: What is sought.
        samples: Rows times joints behind the observations.
        sigma: (n,) deviation each joint is given [N·m].
        prior: Weight of the divergence: the share of a sample it counts, per sample.
    """

    unknowns: Unknowns
    samples: int
    sigma: FloatArray
    prior: float

    def frozen(self, system: System, start: FloatArray) -> Minimum:
        """The minimum with shapes left where they are: all rows as one triangle."""
        X, y, joint = system
        linear = self.unknowns.linear
        weighted = np.column_stack([X[:, :linear], y]) / self.sigma[joint, None]
        R = upper_triangle(weighted)
        moved = start.size - self.unknowns.counts[2]

        def residual(u: FloatArray) -> tuple[FloatArray, FloatArray]:
            values, slope = self.unknowns.at(np.concatenate([u, start[moved:]]))
            r = R[:, :-1] @ values[:linear] - R[:, -1]
            return self._with_prior(u, r, R[:, :-1] @ slope[:linear, :moved])

        found = minimise(residual, start[:moved])
        whole = np.concatenate([found.u, start[moved:]])
        return Minimum(whole, found.cost, found.iterations, found.converged)

    def bending(self, observed: Observed, start: FloatArray) -> Minimum:
        """The minimum over shapes too, whose columns are evaluated anew at every step."""
        linear = self.unknowns.linear

        def residual(u: FloatArray) -> tuple[FloatArray, FloatArray]:
            values, slope = self.unknowns.at(u)
            X, y, joint = observed(values)
            root = 1.0 / self.sigma[joint]
            r = root * (X[:, :linear] @ values[:linear] - y)
            return self._with_prior(u, r, root[:, None] * (X @ slope))

        return minimise(residual, start, tolerance=1e-9)

    def solution(self, u: FloatArray, observed: JointwiseQR) -> Solution:
        """Values at u with the covariance of the delta method, from all observations.

        With D the Jacobian of the values and H that of the cost, (XᵀWX)⁻¹ becomes D H⁻¹ Dᵀ.
        """
        values, slope = self.unknowns.at(u)
        system = X, _, joint = observed.system()
        weight = 1.0 / self.sigma**2
        J = np.sqrt(weight)[joint, None] * (X @ slope)
        _, J = self._with_prior(u, np.zeros(len(J)), J)
        length = np.linalg.norm(J, axis=0)
        length[length == 0] = 1.0
        half = np.linalg.pinv(J / length, rcond=1e-12) / length[:, None]
        bread = slope @ half @ half.T @ slope.T
        linear = self.unknowns.linear
        still = np.concatenate([values[:linear], np.zeros(len(values) - linear)])
        scaled = X * np.sqrt(weight)[joint, None]
        rank, condition = _excited(scaled[:, :linear])
        sigma = observed.residual_std(still)
        return Solution(values, sigma, weight, bread, rank, condition, system)

    def _with_prior(
        self, u: FloatArray, r: FloatArray, J: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        root = np.sqrt(self.prior * self.samples)
        away, slope = self.unknowns.bodies.divergence(u)
        wide = np.zeros((len(away), J.shape[1]))
        wide[:, : slope.shape[1]] = root * slope
        return np.concatenate([r, root * away]), np.vstack([J, wide])


def _excited(X: FloatArray) -> tuple[int, float]:
    """Rank and condition number of X (m, p) with its columns scaled to length 1."""
    length = np.linalg.norm(X, axis=0)
    singular = np.linalg.svd(X / np.where(length > 0, length, 1.0), compute_uv=False)
    kept = singular > 1e-9 * singular[0]
    return int(kept.sum()), float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
