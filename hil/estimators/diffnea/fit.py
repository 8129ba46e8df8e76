"""One fit, step by step: shapes as they start, then bent, then everything on all rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray
from hil.estimators.diffnea.problem import Problem
from hil.estimators.diffnea.rows import BendingRows
from hil.estimators.diffnea.unknowns import Unknowns
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares

ROUNDS = 2
"""How often shapes are fitted, with the joints' weights renewed in between."""

LEAST_NOISE = 1e-6
"""A joint's deviation is at least this share of its torque: exact data would weigh by 1/0."""

USUAL_FRICTION = 0.1
"""Scale of a friction coefficient: it makes this share of the joint's torque."""


@dataclass(frozen=True, slots=True, eq=False)
class DiffneaFit:
    """Where a fit stands.

    Attributes:
        problem: What is minimised.
        u: (U,) coordinates.
        floor: (n,) least deviation of a joint [N·m].
        iterations: Steps so far.
    """

    problem: Problem
    u: FloatArray
    floor: FloatArray
    iterations: int = 0

    @classmethod
    def begun(cls, unknowns: Unknowns, observed: JointwiseQR, prior: float) -> DiffneaFit:
        """The nominal arm fitted with shapes as they start; observations have those shapes.

        Joints are weighted by the residual of an unconstrained fit with equal weights.
        """
        torque = _torque(observed)
        unknowns = replace(unknowns, scale=_usual_scale(unknowns, observed, torque))
        plain = jointwise_least_squares(observed, weighted=False)
        floor = np.maximum(LEAST_NOISE * torque, 1e-12)
        problem = Problem(unknowns, np.maximum(plain.sigma, floor), prior)
        return cls(problem, unknowns.start(), floor).finished(observed)

    def bent(self, rows: BendingRows) -> DiffneaFit:
        """Shapes fitted too, joints weighted anew."""
        fit = self
        for _ in range(ROUNDS):
            found = fit.problem.bending(rows, fit.u)
            sigma = np.maximum(rows.deviation(fit.problem.unknowns.at(found.u)[0]), self.floor)
            problem = replace(fit.problem, sigma=sigma)
            fit = replace(
                fit, problem=problem, u=found.u, iterations=fit.iterations + found.iterations
            )
        return fit

    def finished(self, observed: JointwiseQR) -> DiffneaFit:
        """Everything but the shapes, on all observations."""
        found = self.problem.frozen(observed.system(), self.u)
        return replace(self, u=found.u, iterations=self.iterations + found.iterations)

    @property
    def values(self) -> FloatArray:
        """Base parameters, friction coefficients and shapes."""
        return self.problem.unknowns.at(self.u)[0]

    @property
    def inertial(self) -> FloatArray:
        """(11n,) full inertial parameters."""
        return self.problem.unknowns.bodies.parameters(self.u)

    def notes(self, joints: tuple[str, ...]) -> tuple[str, ...]:
        """What ended at its bound."""
        return self.problem.unknowns.notes(self.u, joints)

    def solution(self, observed: JointwiseQR) -> Solution:
        """The values and what their uncertainty needs."""
        return self.problem.solution(self.u, observed)


def _torque(observed: JointwiseQR) -> FloatArray:
    """(n,) root mean square of each joint's target [N·m]."""
    _, y, joint = observed.system()
    squares = np.bincount(joint, y**2, minlength=len(observed.rows))
    return np.asarray(np.sqrt(squares / np.maximum(observed.rows, 1)))


def _usual_scale(unknowns: Unknowns, observed: JointwiseQR, torque: FloatArray) -> FloatArray:
    """(n, k) coefficients with which a column makes a usual share of the joint's torque."""
    X, _, joint = observed.system()
    n, k = unknowns.scale.shape
    first = unknowns.counts[0]
    scale = np.ones((n, k))
    for j in range(n):
        own = X[joint == j, first + j * k : first + (j + 1) * k]
        size = np.linalg.norm(own, axis=0) / np.sqrt(max(int(observed.rows[j]), 1))
        usual = USUAL_FRICTION * max(torque[j], 1e-9)
        scale[j] = usual / np.where(size > 0, np.maximum(size, 1e-3), 1.0)
    return scale
