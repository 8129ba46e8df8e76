"""The honest protocol, computed: every method predicts the dwells of poses it has not seen.

All methods see the same dwells and are judged on the same poses. Whatever is tuned is tuned inside
the training poses: the epoch at which networks stop and their weight decay by poses held out from
the training, the strength of the hysteresis model's correction by folds of its own.

Poses approached from both sides need no model (`bands`): the mean of the two sides is gravity, half
their difference stick friction.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import Any, TypeAlias

import numpy as np

from hil.core import BoolArray, DataError, FitError, FloatArray, HilError, IntArray
from hil.data import Dataset, Split, correlation, kfold, rmse, split
from hil.dynamics import RobotModel
from hil.estimators import estimator
from hil.networks import ConstantInputWarning
from hil.studies.separation_data import Recording, bare, dwell_means, dwells_in, mean_noise, pairs
from hil.studies.tasks import Task


@dataclass(frozen=True, slots=True)
class Method:
    """A way to predict the current of a dwell.

    Attributes:
        key: In the spec.
        words: In tables.
        estimator: Name it is registered under.
        params: Of the estimator.
        grid: Further parameters to choose among by the poses a network holds out.
        cost: How long a fit takes compared with others.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    grid: tuple[Mapping[str, Any], ...] = ({},)
    cost: float = 1.0

    def candidates(self) -> tuple[Method, ...]:
        """One for each entry of the grid."""
        return tuple(
            replace(self, params={**self.params, **chosen}, grid=(chosen,)) for chosen in self.grid
        )


WEIGHT_DECAYS = (0.0, 1e-4, 1e-3)
"""Candidates for the networks."""

NETWORK_COST = 10.0
"""Seconds that six networks take until they stop, about."""


def known_methods(
    *, alpha: float, weights: str, layout: tuple[int, ...], epochs: int, seed: int
) -> dict[str, Method]:
    """All methods by key, gravity alone first and ours last."""
    linear = {"alpha": alpha}
    decays = tuple({"weight_decay": decay} for decay in WEIGHT_DECAYS)
    network = {"epochs": epochs, "seed": seed}
    angles = ["q2", "q3", "q4", "q5"]
    with_approach = {"inputs": [*angles, "approach"], "layers": [5, *layout[1:]]}
    found = (
        Method("gravity", "gravity by WLS, shared", "static-wls"),
        Method("gravity-paper", "gravity by WLS, eq. 15", "static-wls", {"form": "paper"}),
        Method("ls", "least squares", "static-linear", {"method": "ls"}),
        Method("ridge", "ridge", "static-linear", {"method": "ridge", **linear}),
        Method("lasso", "LASSO", "static-linear", {"method": "lasso", **linear}),
        Method("elastic-net", "elastic net", "static-linear", {"method": "elastic-net", **linear}),
        Method("wls", "WLS", "static-linear", {"method": "wls", "weights": weights}),
        Method("inverse", "eq. 16 inverted", "static-inverse"),
        Method("coulomb", "gravity + Fc·sign(approach)", "static-coulomb"),
        Method(
            "network", "gravity + network of q2…q5", "static-mlp-lm",
            {**network, "inputs": angles, "layers": list(layout)}, decays, NETWORK_COST,
        ),
        Method(
            "network-approach", "gravity + network of q2…q5, approach", "static-mlp-lm",
            {**network, **with_approach}, decays, NETWORK_COST,
        ),
        Method("hysteresis", "ours: friction with memory", "static-hysteresis"),
    )  # fmt: skip
    return {method.key: method for method in found}


METHOD_KEYS = tuple(known_methods(alpha=0.001, weights="paper", layout=(4, 1), epochs=1, seed=0))


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


LEAST_SAID = 0.5
"""A method that predicts less of the dwells than this would leave nothing to compare."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one fit of one method says about the dwells it was not fitted to.

    Attributes:
        effort: (S, n) mean over each dwell; NaN where the model cannot say.
        std: (S, n) one standard deviation of that, NaN where the model cannot say.
        own_error: What the model itself found on poses it held out within its training, mean over
            the joints; of its training where it held out none.
        seconds: The fit took, of one core.
        failed: Why there is nothing, in words; empty when there is.
        chosen: The candidate of the method's grid, in words; empty with only one.
    """

    effort: FloatArray
    std: FloatArray
    own_error: float = np.inf
    seconds: float = 0.0
    failed: str = ""
    chosen: str = ""


def fit_tasks(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> list[Task]:
    """Fit every candidate of a method to some dwells and predict others."""
    return [
        Task(partial(_fitted, candidate, train, test, robot), candidate.cost)
        for candidate in method.candidates()
    ]


def _fitted(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> Outcome:
    nothing = np.full((len(test.conditions), test.n_joints), np.nan)
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstantInputWarning)
            model = estimator(method.estimator, **method.params).fit(train, robot)
        seconds = time.process_time() - begin
        predicted = model.predict(test)
    except HilError as error:
        return Outcome(nothing, nothing, failed=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the hour the others took.
    except Exception as error:
        words = f"it broke down: {type(error).__name__}: {error}"
        return Outcome(nothing, nothing, failed=words)
    effort = dwell_means(test, np.where(predicted.valid, predicted.effort, np.nan))
    std = dwell_means(test, np.array(predicted.std))
    chosen = ", ".join(f"{name} {value:g}" for name, value in method.grid[0].items())
    return Outcome(effort, std, float(np.mean(model.sigma_)), seconds, "", chosen)


def best_of(outcomes: Sequence[Outcome]) -> Outcome:
    """The candidate with the least error of its own; the time of all of them."""
    best = min(outcomes, key=lambda outcome: outcome.own_error)
    return replace(best, seconds=sum(outcome.seconds for outcome in outcomes))


Measure: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]

WITHIN = 1.96
"""Standard deviations that 95 % of normal errors stay within."""


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


GRAVITY = ("gravity", "gravity-paper", "wls", "ls", "ridge")
"""What stands for a model without friction: the first of them that was fitted."""

FRICTION = ("coulomb", "network-approach", "hysteresis")
"""Methods that know the approach, ours last."""

SHORT = {"coulomb": "Fc·sign", "network-approach": "network", "hysteresis": "ours"}


def bands(run: HonestRun) -> Bands | None:
    """What poses approached from both sides tell; None when there are none."""
    conditions = [run.dwells.conditions[number] for number in run.judged_dwells]
    both = pairs(tuple(conditions))
    if not both:
        return None
    predicted = {key: _sides(one.effort, both) for key, one in run.methods.items()}
    common = np.array([run.common[below + above].all(axis=0) for below, above in both])
    return Bands(_sides(run.measured, both), predicted, common, run.dwells.effort_unit)


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Measured and predicted, pose by pose.

    Attributes:
        measured: Of the recording.
        predicted: By the methods, by key; of poses they have not seen.
        common: (P, n) where both approaches are compared.
        unit: Of the effort.
    """

    measured: Sides
    predicted: dict[str, Sides]
    common: BoolArray
    unit: str

    @property
    def load(self) -> FloatArray:
        """(P, n) what the drive holds beside friction."""
        return np.abs(self.measured.mean)


@dataclass(frozen=True, slots=True, eq=False)
class Sides:
    """Mean and half difference of both approaches; (P, n) each.

    Attributes:
        mean: Of the dwells from below and from above.
        half: Half of below less above.
    """

    mean: FloatArray
    half: FloatArray


def _sides(values: FloatArray, both: list[tuple[list[int], list[int]]]) -> Sides:
    below = np.array([values[numbers].mean(axis=0) for numbers, _ in both])
    above = np.array([values[numbers].mean(axis=0) for _, numbers in both])
    return Sides((below + above) / 2, (below - above) / 2)


def gravity_of(found: Bands) -> str | None:
    """The method that stands for gravity alone."""
    return next((key for key in GRAVITY if key in found.predicted), None)


def friction_of(found: Bands) -> list[str]:
    """Methods that predict a band at all."""
    return [key for key in FRICTION if key in found.predicted]
