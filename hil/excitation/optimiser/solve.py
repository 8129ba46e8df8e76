"""Optimised Fourier excitation: several random starts, each improved under all limits."""

from __future__ import annotations

import time

import numpy as np

from hil.core import FloatArray, PlanError
from hil.dynamics import conditioning
from hil.excitation.optimiser.draw import draw
from hil.excitation.optimiser.improve import Search
from hil.excitation.optimiser.linear_limits import LinearLimits
from hil.excitation.optimiser.margins import DENSER, margins_of
from hil.excitation.optimiser.motion_limits import RESERVE, MotionLimits
from hil.excitation.optimiser.objective import ValueOf
from hil.excitation.optimiser.problem import ExcitationProblem
from hil.excitation.optimiser.result import Optimised, Progress, ProgressCallback, Start

ROUNDS = 5
"""More of the last stage, while what it finds exceeds limits between the points."""

ITERATIONS = 200


def optimise(
    problem: ExcitationProblem,
    *,
    starts: int = 3,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    cpu_s: float = 60.0,
    iterations: int = ITERATIONS,
) -> Optimised:
    """The best of several local optima.

    Args:
        problem: What is asked for.
        starts: Number of random starts.
        seed: Of the starts; the same seed gives the same series.
        progress: Told now and then how far it is; may raise to stop the search.
        cpu_s: CPU time for all starts. When it is spent the search ends with what it has, which
            then depends on the computer.
        iterations: Of one start at most.

    Raises:
        PlanError: No start found a motion within all limits; says which limit is in the way.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # matrices are small: threads would only wait for each other
        return _optimise(problem, starts, seed, progress, cpu_s, iterations)


def _optimise(
    problem: ExcitationProblem,
    starts: int,
    seed: int,
    progress: ProgressCallback | None,
    cpu_s: float,
    iterations: int,
) -> Optimised:
    begun = time.process_time()
    tale = _Tale(starts, iterations, progress)
    done: list[tuple[Start, FloatArray]] = []
    for number in range(max(1, starts)):
        if number and time.process_time() > begun + cpu_s:
            break
        one = _Attempt(problem, (seed, number), iterations, begun + cpu_s, tale)
        done.append(one.run())
        tale.ended(done[-1][0].value)
    best, free = min(done, key=lambda pair: pair[0].value)
    if not np.isfinite(best.value):
        spent = time.process_time() > begun + cpu_s
        raise PlanError(
            f"no Fourier series was found within all limits, from {len(done)} random starts"
            + (f" in {cpu_s:g} s of CPU time: " if spent else ": ")
            + (MotionLimits(problem).complaint(free) or "limits are exceeded between the points"),
            hint=("give it more time, or " if spent else "give it ")
            + "more room: wider limits, less clearance, more starts or another seed",
        )
    return _result(problem, free, tuple(start for start, _ in done), time.process_time() - begun)


class _Attempt:
    """One start, from its draw to a motion within all limits."""

    def __init__(
        self,
        problem: ExcitationProblem,
        seed: tuple[int, int],
        iterations: int,
        deadline: float,
        tale: _Tale,
    ) -> None:
        self._problem, self._seed, self._iterations = problem, seed, iterations
        self._value_of, self._others = ValueOf(problem), MotionLimits(problem)
        linear, rng = LinearLimits(problem), np.random.default_rng(seed)
        free = draw(linear, self._others, rng, problem.centres)
        self._found: FloatArray | None = None
        self._value = np.inf
        tale.begins(seed[1])
        self._search = Search(linear, self._others, self._value_of, free, tale.step, deadline)

    def run(self) -> tuple[Start, FloatArray]:
        """How it went, and the best motion: where none is within limits, the last one."""
        begun = time.process_time()
        search, stages = self._search, self._value_of.stages
        drawn = self._value_of(search.free, stages[-1]).exact
        for stage, sharpness in enumerate(stages):
            left = self._iterations - search.iterations
            search.run(sharpness, -(-left // (len(stages) - stage)))
            self._check()
        for _ in range(ROUNDS):
            if search.best is not None or search.ended == "budget":
                break
            search.run(stages[-1], max(10, self._iterations // 6))
            self._check()
        start = Start(
            seed=self._seed,
            drawn=drawn,
            value=self._value,
            iterations=search.iterations,
            evaluations=self._value_of.evaluations,
            cpu_s=time.process_time() - begun,
            ended="infeasible" if self._found is None else search.ended,
        )
        return start, search.free if self._found is None else self._found

    def _check(self) -> None:
        """Keep the best motion if it is within all limits between the points, too.

        If not, take off the limits what it exceeds them by, and let the search go on from there.
        """
        search, others = self._search, self._others
        if search.best is None or search.best_value >= self._value:
            return
        exceeded = others.exceeded(search.best, DENSER)
        if not np.any(exceeded > 0):
            self._found, self._value = search.best, search.best_value
            return
        others.reserve += np.where(exceeded > 0, exceeded + RESERVE, 0.0)
        search.forget()


class _Tale:
    """What the progress callback is told."""

    def __init__(self, starts: int, iterations: int, progress: ProgressCallback | None) -> None:
        self._starts, self._iterations, self._progress = starts, iterations, progress
        self._begun, self._number, self._best = time.monotonic(), 0, np.inf

    def begins(self, number: int) -> None:
        self._number = number

    def ended(self, value: float) -> None:
        self._best = min(self._best, value)

    def step(self, search: Search) -> None:
        if self._progress is None:
            return
        elapsed = time.monotonic() - self._begun
        share = min(search.iterations / self._iterations, 1.0)
        done = (self._number + share) / self._starts
        self._progress(
            Progress(
                start=self._number,
                starts=self._starts,
                iteration=search.iterations,
                value=search.best_value,
                best=min(self._best, search.best_value),
                violation=search.violation,
                elapsed_s=elapsed,
                eta_s=elapsed * (1.0 - done) / done if done else None,
            )
        )


def _result(
    problem: ExcitationProblem, free: FloatArray, starts: tuple[Start, ...], cpu_s: float
) -> Optimised:
    series = problem.basis.series(free, problem.periods)
    information = problem.information(series)
    condition = conditioning(information)
    log_det = 2.0 * float(np.log(np.abs(np.diag(information))).sum())
    by_objective = condition.scaled if problem.scaled else condition.raw
    return Optimised(
        series=series,
        objective=by_objective if problem.objective == "condition" else log_det,
        condition_raw=condition.raw,
        condition_scaled=condition.scaled,
        margins=margins_of(problem, series),
        information=information,
        starts=starts,
        cpu_s=cpu_s,
    )
