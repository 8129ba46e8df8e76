"""Both protocols of a study of dynamic identification: which fits, and what came of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.studies.dynamic_data import Parts, Trajectories, honest_parts, paper_parts
from hil.studies.dynamic_methods import Method, Score, fit_and_score, shown_rows
from hil.studies.separation_tasks import Task

PROTOCOLS: Mapping[str, Callable[[Trajectories, int], Parts]] = {
    "paper": paper_parts,
    "honest": honest_parts,
}

MEASURES = ("filtered", "raw", "moving", "reversal", "percent", "training")
"""Attributes of a `Score` that are per joint."""

COLUMNS = ("t", "q", "qd", "qdd", "effort", "temperature")
"""What estimators may ask for, beside what the study added: the rest does not travel."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One protocol: the same splits for every method.

    Attributes:
        protocol: Its name.
        scores: By key of the method, one per split; methods that failed in any are left out.
        failed: By key of the method, why.
        t, measured: (rows,), (rows, n) time and torque that `Score.shown` predicts, first split.
        noise: (n,) RMS of what the filter took out of the measured effort, in N·m.
    """

    protocol: str
    scores: Mapping[str, Sequence[Score]]
    failed: Mapping[str, str]
    t: FloatArray
    measured: FloatArray
    noise: FloatArray

    def mean(self, key: str, measure: str) -> FloatArray:
        """(n,) mean over the splits."""
        return np.asarray(np.mean(self._all(key, measure), axis=0))

    def spread(self, key: str, measure: str) -> float:
        """Standard deviation over the splits of the mean over the joints; NaN with one split."""
        means = np.mean(self._all(key, measure), axis=1)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str) -> float:
        """Mean over joints and splits, NaN where a joint has none."""
        return float(np.mean(self.mean(key, measure)))

    def _all(self, key: str, measure: str) -> FloatArray:
        return np.stack([getattr(score, measure) for score in self.scores[key]])


class Protocol:
    """Prepares the fits of one protocol, and gathers what came of them.

    Args:
        name: Key of `PROTOCOLS`.
        trajectories: Of the run.
        robot: Model of the arm.
        methods: To compare.
        seeds: One split each.
        sign_width: Of the smooth sign, the same for every method that has one.
    """

    def __init__(
        self,
        name: str,
        trajectories: Trajectories,
        robot: RobotModel,
        methods: Sequence[Method],
        seeds: Sequence[int],
        sign_width: float,
    ) -> None:
        self.name = name
        self._robot, self._sign_width = robot, sign_width
        self._scale = trajectories.scale
        torn = name == "paper"
        self._methods = tuple(method for method in methods if not (torn and method.memory))
        # Torn samples cannot be thinned again: no filter knows how far apart they are.
        once = {"every": 1} if torn else {}
        self._filters = trajectories.filters.model_copy(update=once)
        lighter = replace(
            trajectories, data=light(trajectories.data), thinned=light(trajectories.thinned)
        )
        self._splits = [PROTOCOLS[name](lighter, seed) for seed in seeds]

    def tasks(self) -> list[Task]:
        """Every fit, in the order `gather` wants their results."""
        return [
            Task(
                partial(fit_and_score, method, parts, self._robot, self._sign_width, self._filters),
                name=f"{method.key}, {self.name}, draw {number}",
                failed=_failed,
            )
            for method in self._methods
            for number, parts in enumerate(self._splits, start=1)
        ]

    def gather(self, results: Iterator[Score]) -> Found:
        """The results of `tasks`, taken from the front of `results`."""
        scores: dict[str, list[Score]] = {}
        failed: dict[str, str] = {}
        for method in self._methods:
            found = [next(results) for _ in self._splits]
            reason = next((score.failed for score in found if score.failed), "")
            if reason:
                failed[method.key] = reason
            else:
                scores[method.key] = found
        test, scale = self._splits[0].test, self._scale
        noise = np.sqrt(np.mean((test["effort"] - test["effort_f"]) ** 2, axis=0)) * scale
        rows = shown_rows(test)
        shown = test["effort_f"][rows] * scale
        return Found(self.name, scores, failed, test["t"][rows], shown, noise)


def _failed(score: Score) -> str:
    """As `Ended` tells it."""
    return "failed" if score.failed else ""


def light(data: Dataset) -> Dataset:
    """With no more columns than estimators may ask for."""
    kept = [
        name
        for name in data.columns
        if name in COLUMNS or name.endswith("_f") or name.startswith("joint_")
    ]
    return replace(data, columns={name: data[name] for name in kept})
