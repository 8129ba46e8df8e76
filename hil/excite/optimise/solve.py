"""Optimised Fourier excitation: several random starts, each improved under all limits."""

from __future__ import annotations

from hil.excite.optimise.problem import ExcitationProblem
from hil.excite.optimise.result import Optimised, ProgressCallback


def optimise(
    problem: ExcitationProblem,
    *,
    starts: int = 3,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    cpu_s: float = 60.0,
    iterations: int = 200,
) -> Optimised:
    """The best of several local optima.

    Args:
        problem: What is asked for.
        starts: Number of random starts.
        seed: Of the starts; the same seed gives the same series.
        progress: Told now and then how far it is; may raise to stop the search.
        cpu_s: CPU time for all starts; none begins after it is spent. The result depends on the
            computer when it is reached.
        iterations: Of one start at most.

    Raises:
        PlanError: No start found a motion within all limits; says which limit is in the way.
    """
    raise NotImplementedError
