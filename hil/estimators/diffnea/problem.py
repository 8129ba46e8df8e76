"""The least-squares problem: weighted torque residuals and a weak pull towards the nominal arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray
from hil.estimators.diffnea.minimise import Cost, Local, Minimum, minimise
from hil.estimators.diffnea.unknowns import Unknowns
from hil.estimators.least_squares import JointwiseQR, Solution, System, upper_triangle

Observed = Callable[[FloatArray], System]
"""Values → an equivalent small system whose columns are those of the values, slopes included."""

BENT_ENOUGH = 1e-6
"""Relative decrease below which shapes are left alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Σⱼ |rⱼ|²/σⱼ² + prior · divergence from nominal.

    Attributes:
        unknowns: What is sought.
        sigma: (n,) deviation each joint is given [N·m].
        prior: How many samples a unit of divergence counts for.
    """

    unknowns: Unknowns
    sigma: FloatArray
    prior: float

    def frozen(self, system: System, start: FloatArray) -> Minimum:
        """The minimum with shapes left where they are: all rows as one triangle."""
        X, y, joint = system
        linear = self.unknowns.linear
        weighted = np.column_stack([X[:, :linear], y]) / self.sigma[joint, None]
        R = upper_triangle(weighted)
        moved = start.size - self.unknowns.counts[2]

        def cost(moving: FloatArray) -> Local:
            u = np.concatenate([moving, start[moved:]])
            values, slope = self.unknowns.at(u)
            r = R[:, :-1] @ values[:linear] - R[:, -1]
            return _cut(self._local(u, r, R[:, :-1] @ slope[:linear]), moved)

        found = minimise(cost, start[:moved])
        return replace(found, u=np.concatenate([found.u, start[moved:]]))

    def bending(self, observed: Observed, start: FloatArray) -> Minimum:
        """The minimum over shapes too, whose columns are evaluated anew at every step."""
        return minimise(self.bending_cost(observed), start, tolerance=BENT_ENOUGH)

    def bending_cost(self, observed: Observed) -> Cost:
        """The cost by all coordinates, shapes included."""
        linear = self.unknowns.linear

        def cost(u: FloatArray) -> Local:
            values, slope = self.unknowns.at(u)
            X, y, joint = observed(values)
            root = 1.0 / self.sigma[joint]
            r = root * (X[:, :linear] @ values[:linear] - y)
            return self._local(u, r, root[:, None] * (X @ slope))

        return cost

    def solution(self, u: FloatArray, observed: JointwiseQR) -> Solution:
        """Values at u with the covariance of the delta method, from all observations.

        With D the Jacobian of the values and H half the curvature, (XᵀWX)⁻¹ becomes D H⁻¹ Dᵀ.
        """
        values, slope = self.unknowns.at(u)
        system = X, _, joint = observed.system()
        weight = 1.0 / self.sigma**2
        scaled = X * np.sqrt(weight)[joint, None]
        H = 0.5 * self._local(u, np.zeros(len(X)), scaled @ slope).curvature
        length = np.sqrt(np.diag(H))
        length[length == 0] = 1.0
        inverse = np.linalg.pinv(H / np.outer(length, length), rcond=1e-13, hermitian=True)
        to = slope / length
        linear = self.unknowns.linear
        straight = np.concatenate([values[:linear], np.zeros(len(values) - linear)])
        rank, condition = _excited(scaled[:, :linear])
        sigma = observed.residual_std(straight)
        return Solution(values, sigma, weight, to @ inverse @ to.T, rank, condition, system)

    def _local(self, u: FloatArray, r: FloatArray, J: FloatArray) -> Local:
        away, pull = self.unknowns.divergence(u), self.prior
        return Local(
            float(r @ r) + pull * away.cost,
            2.0 * J.T @ r + pull * away.gradient,
            2.0 * J.T @ J + pull * away.curvature,
        )


def _cut(local: Local, moved: int) -> Local:
    """The same for the first coordinates alone."""
    return Local(local.cost, local.gradient[:moved], local.curvature[:moved, :moved])


def _excited(X: FloatArray) -> tuple[int, float]:
    """Rank and condition number of X (m, p) with its columns scaled to length 1."""
    length = np.linalg.norm(X, axis=0)
    singular = np.linalg.svd(X / np.where(length > 0, length, 1.0), compute_uv=False)
    kept = singular > 1e-9 * singular[0]
    return int(kept.sum()), float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
