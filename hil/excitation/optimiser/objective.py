"""The objective and its exact gradient by the free coefficients."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hil.core import FloatArray
from hil.dynamics import log_condition, neg_log_det

if TYPE_CHECKING:
    from hil.excitation.optimiser.problem import ExcitationProblem


class Value(NamedTuple):
    """The objective at a point.

    Attributes:
        value: What is minimised, smooth.
        gradient: (n·f,) by the free coefficients.
        exact: The condition number, or −log det.
    """

    value: float
    gradient: FloatArray
    exact: float


class ValueOf:
    """The objective of a problem.

    Args:
        problem: Whose.

    Attributes:
        evaluations: So far.
        stages: Sharpness of `hil.dynamics.information.log_condition`, stage by stage.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        self._problem = problem
        self._maps = problem.basis.grid(problem.points)[:3]
        self._earlier = 0.0 if problem.earlier is None else problem.earlier.T @ problem.earlier
        self.evaluations = 0
        self.stages = (2.0, 8.0, 32.0, 128.0) if problem.objective == "condition" else (1.0,)

    def __call__(self, free: FloatArray, sharpness: float) -> Value:
        """At free coefficients (n, f)."""
        self.evaluations += 1
        rows = self._problem.columns.rows(*(part @ free.T for part in self._maps))
        G = rows.transposed @ rows.transposed.T + self._earlier
        if self._problem.objective == "condition":
            measure = log_condition(G, sharpness, self._problem.scaled)
        else:
            measure = neg_log_det(G)
            measure = measure._replace(exact=-measure.exact)
        by_motion = rows.pull_back(2.0 * measure.gradient @ rows.transposed)
        parts = [part.T @ by for part, by in zip(self._maps, by_motion, strict=True)]
        return Value(measure.value, np.sum(parts, axis=0).T.ravel(), measure.exact)
