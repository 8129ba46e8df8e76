"""Fourier trajectories by optimisation, one after the other: each complements those before it.

The information of the trajectories found so far is given to the next search, so condition number
and determinant are those of all of them together. Any first few of them are as good as so many
can be made in this way, which is why asking for more goes on from those that are known.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hil.core import PlanError, RecordingError
from hil.excitation.cache import DamagedEntry
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser import optimise
from hil.excitation.question import Question
from hil.excitation.roadmap import Roadmap
from hil.excitation.setting import Advance
from hil.excitation.workspace import Workspace

if TYPE_CHECKING:
    from hil.excitation.optimiser import ExcitationProblem, Progress

ATTEMPTS = 3
"""Searches for one trajectory: a motion may be clear in itself and still be out of reach."""

SCALES = (1.0, 0.99, 0.95, 0.9, 0.8)
"""Tried from the largest, should a motion not be clear at the robot's own samples."""

TOLERANCE = 1e-9
"""Like that of a plan's margins."""


@dataclass(eq=False)
class OptimisedSeries:
    """The answers to a question.

    Attributes:
        question: What is asked.
        roadmap: How to get about.
    """

    question: Question
    roadmap: Roadmap
    _began: float = 0.0
    _took_s: list[float] = field(default_factory=list)

    def all(self) -> list[FourierSeries]:
        """As many as the spec asks for, from the cache as far as it has them.

        Raises:
            PlanError: No motion within all limits was found.
        """
        wanted, key = self.question.spec.trajectories, self.question.key
        found = self._kept(key)
        for _ in range(len(found), wanted):
            self._began = time.monotonic()
            found.append(self._next(found))
            self._took_s.append(time.monotonic() - self._began)
            self._keep(key, found)
        return found[:wanted]

    def _next(self, found: Sequence[FourierSeries]) -> FourierSeries:
        """The next trajectory.

        Raises:
            PlanError: None is found.
        """
        number, problem = len(found) + 1, self.question.problem(found)
        if self.roadmap.workspace.space is not None:
            # Few poses of the joint ranges are inside the space; those of the roadmap are.
            problem = replace(problem, centres=self.roadmap.poses)
        failure = PlanError(
            f"trajectory {number}: {ATTEMPTS} optimised motions keep their limits, but the arm "
            "cannot get to where they begin without coming too close to something",
            hint="raise excitation.optimise.starts, or set excitation.range_deg where there is "
            "room",
        )
        for attempt in range(ATTEMPTS):
            try:
                best = self._search(problem, number, attempt)
            except PlanError as error:
                failure = PlanError(f"trajectory {number}: {error.message}", hint=error.hint)
                continue
            for scale in SCALES:
                if self._is_possible(series := scaled(best, scale)):
                    return series
        raise failure

    def _search(self, problem: ExcitationProblem, number: int, attempt: int) -> FourierSeries:
        """The best motion of one search.

        Raises:
            PlanError: It found none within all limits.
        """
        seeds = np.random.SeedSequence([self.question.seed, number, attempt])
        return optimise(
            problem,
            starts=self.question.asked.starts,
            seed=int(seeds.generate_state(1)[0]),
            progress=lambda progress: self._tell(number, progress),
            cpu_s=self.question.asked.budget_s,
        ).series

    def _is_possible(self, series: FourierSeries) -> bool:
        """Whether it keeps its limits at the robot's own samples, is clear and can be reached."""
        workspace = self.roadmap.workspace
        return (
            _is_within(workspace, series)
            and bool(workspace.depths([series])[0] >= self.question.clearance_m - TOLERANCE)
            and bool(workspace.clearances([series])[0] >= self.question.clearance_m - TOLERANCE)
            and self.roadmap.way(self.roadmap.home, series.q_start) is not None
        )

    def _kept(self, key: str) -> list[FourierSeries]:
        """What the cache has, as far as it is possible here."""
        try:
            kept = self.question.setting.cache.read(key)
        except DamagedEntry as damage:
            self.question.setting.watch(
                Advance(note=f"{damage}; the trajectories are computed again")
            )
            return []
        return list(kept) if all(map(self._is_possible, kept)) else []

    def _keep(self, key: str, found: Sequence[FourierSeries]) -> None:
        try:
            self.question.setting.cache.write(key, found)
        except RecordingError as error:
            self._note(f"{error.message}; the trajectories will be computed again next time")

    def _note(self, text: str) -> None:
        self.question.setting.watch(Advance(note=text))

    def _tell(self, number: int, progress: Progress) -> None:
        asked = self.question.asked
        best = progress.best if asked.objective == "condition" else float("inf")
        total, start = self.question.spec.trajectories, progress.start + 1
        left = self._left_s(total - number, progress.eta_s)
        self.question.setting.watch(Advance(number, total, start, progress.starts, best, left))

    def _left_s(self, others: int, eta_s: float | None) -> float | None:
        """Time left for the trajectory at work and `others`; a search tells `eta_s` for its own.

        A search cannot know how soon it converges: those before it are the better measure.
        """
        now = time.monotonic()
        if not self._took_s:
            return None if eta_s is None else (now - self._began + eta_s) * others + eta_s
        each = sum(self._took_s) / len(self._took_s)
        own = max(each - (now - self._began), 0.1 * each)
        return each * others + (own if eta_s is None else min(own, eta_s))


def scaled(series: FourierSeries, scale: float) -> FourierSeries:
    """The same motion about its centre, everything multiplied by `scale`."""
    a, b = (
        tuple(tuple(scale * value for value in row) for row in rows)
        for rows in (series.a, series.b)
    )
    return replace(series, a=a, b=b)


def _is_within(workspace: Workspace, series: FourierSeries) -> bool:
    samples = series.sample(workspace.rate_hz)
    return bool(
        np.abs(samples.qd).max() <= workspace.velocity + TOLERANCE
        and np.abs(samples.qdd).max() <= workspace.acceleration + TOLERANCE
        and np.all(samples.q >= workspace.low - TOLERANCE)
        and np.all(samples.q <= workspace.high + TOLERANCE)
    )
