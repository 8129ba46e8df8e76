"""The honest protocol, computed: every method predicts the dwells of poses it has not seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numpy as np

from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray
from hil.data import Dataset, Split, correlation, kfold, rmse, split
from hil.studies.separation_data import Recording, bare, dwell_means, dwells_in, mean_noise
from hil.studies.separation_methods import Method, Outcome, best_of, fit_tasks
from hil.studies.separation_tasks import Task

Measure: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]

WITHIN = 1.96
"""Standard deviations that 95 % of normal errors stay within."""

LEAST_SAID = 0.5
"""A method that predicts less of the dwells than this would leave nothing to compare."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One method on dwells it was not fitted to; rows as `HonestRun.measured`.

    Attributes:
        method: Which one.
        effort: (S, n) predicted.
        std: (S, n) one standard deviation, NaN where the method cannot say.
        seconds: Mean time of a fit, tuning included, on one core.
        chosen: What was chosen by nested validation, fold by fold, in words.
    """

    method: Method
    effort: FloatArray
    std: FloatArray
    seconds: float
    chosen: str


@dataclass(frozen=True, slots=True, eq=False)
class HonestRun:
    """Everything found under the honest protocol.

    Attributes:
        dwells: All dwells of the run.
        judged_dwells: (S,) numbers of those that were held out once.
        measured: (S, n) mean effort of each.
        common: (S, n) where every method says something; only there they are compared.
        methods: By key, those that could be fitted.
        folds: How many splits there were.
        noise: (n,) what the samples' scatter leaves in the mean of a dwell.
        notes: What was left out, and why.
    """

    dwells: Dataset
    judged_dwells: IntArray
    measured: FloatArray
    common: BoolArray
    methods: Mapping[str, Judged]
    folds: int
    noise: FloatArray
    notes: tuple[str, ...]

    def rmse(self, key: str) -> FloatArray:
        """(n,) error of a method."""
        return self._per_joint(lambda a, b: rmse(a, b), self.methods[key].effort)

    def correlation(self, key: str) -> FloatArray:
        """(n,) R of predicted and measured."""
        return self._per_joint(lambda a, b: correlation(a, b), self.methods[key].effort)

    def coverage(self, key: str) -> FloatArray:
        """(n,) share of errors within ±1.96 std; NaN for methods that tell none."""
        one = self.methods[key]
        inside = np.abs(self.measured - one.effort) <= WITHIN * one.std
        told = self.common & np.isfinite(one.std)
        count = told.sum(axis=0)
        share: FloatArray = (inside & told).sum(axis=0) / np.where(count > 0, count, np.nan)
        return share

    def _per_joint(self, measure: Measure, predicted: FloatArray) -> FloatArray:
        columns = [
            measure(self.measured[rows, j, None], predicted[rows, j, None])
            for j, rows in enumerate(self.common.T)
        ]
        return np.concatenate(columns)


class HonestProtocol:
    """Prepares the fits of the protocol, and gathers what they predict.

    Args:
        recording: The run.
        methods: To compare.
        folds: Each pose is held out in one of them.
        hold_out_percent: A single split with this share of the poses held out instead.
        seed: Of the split.

    Raises:
        FitError: There are too few poses.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        methods: Sequence[Method],
        folds: int,
        hold_out_percent: float | None,
        seed: int,
    ) -> None:
        self._recording, self._methods = recording, tuple(methods)
        dwells = bare(recording.dwells)
        try:
            self._splits = (
                list(kfold(dwells, "pose", folds, seed))
                if hold_out_percent is None
                else [split(dwells, "pose", hold_out_percent / 100.0, seed)]
            )
        except DataError as error:
            raise FitError(error.message, hint=error.hint) from error

    def tasks(self) -> list[Task]:
        """Every fit, in the order `gather` wants their results."""
        return [
            task
            for method in self._methods
            for part in self._splits
            for task in fit_tasks(method, part.train, part.test, self._recording.robot)
        ]

    def gather(self, outcomes: Sequence[Outcome]) -> HonestRun:
        """The results of `tasks`, put together.

        Raises:
            FitError: No method could be fitted.
        """
        dwells, count = self._recording.dwells, len(self._splits)
        remaining = iter(outcomes)
        numbers = np.concatenate([_numbers(part) for part in self._splits])
        order = np.argsort(numbers, kind="stable")
        notes, methods = [], dict[str, Judged]()
        for method in self._methods:
            size = len(method.grid)
            found = [best_of(list(islice(remaining, size))) for _ in range(count)]
            if failed := _failure(found):
                notes.append(f"{method.words} ({method.estimator}) is left out: {failed}")
            else:
                methods[method.key] = _joined(method, found, order)
        if not methods:
            raise FitError(
                f"no method could be fitted: {notes[0]}",
                hint="see the reasons of the others on the page; hil doctor tells what is missing",
            )
        measured = dwell_means(dwells, dwells["effort"])[numbers[order]]
        common = np.ones(measured.shape, dtype=bool)
        for one in methods.values():
            common &= np.isfinite(one.effort)
        unsaid = int(np.count_nonzero(~common.all(axis=1)))
        if unsaid:
            notes.append(
                f"{unsaid} of {len(common)} held-out dwells are not compared in every joint, "
                "because a method says nothing about them (mostly the first of a program, of "
                "which nobody knows how it was approached)"
            )
        noise = mean_noise(dwells)
        return HonestRun(
            dwells, numbers[order], measured, common, methods, count, noise, tuple(notes)
        )


def _failure(found: Sequence[Outcome]) -> str:
    """Why a method cannot be compared; empty when it can."""
    failed = next((outcome.failed for outcome in found if outcome.failed), "")
    if failed:
        return failed
    said = np.isfinite(np.concatenate([outcome.effort for outcome in found])).mean(axis=0)
    return "" if said.min() >= LEAST_SAID else "it says nothing about most of the dwells"


def _joined(method: Method, found: Sequence[Outcome], order: IntArray) -> Judged:
    effort = np.concatenate([outcome.effort for outcome in found])[order]
    std = np.concatenate([outcome.std for outcome in found])[order]
    seconds = float(np.mean([outcome.seconds for outcome in found]))
    chosen = Counter(outcome.chosen for outcome in found if outcome.chosen)
    told = "; ".join(f"{words} in {times}" for words, times in chosen.most_common())
    return Judged(method, effort, std, seconds, told)


def _numbers(part: Split) -> IntArray:
    """(S,) numbers of the dwells a split holds out."""
    return np.asarray(dwells_in(part.test)[part.test.offsets[:-1]])
