"""Honest protocol of the separation study: every method predicts the dwells of held-out poses.

All methods use the same training dwells and are tested on the same poses. Hyperparameters are tuned
on the training poses only. Networks determine the stopping epoch and the weight decay by means of
poses that they hold out of the training data. The hysteresis model determines the strength of its
correction by an inner cross-validation.

Gravity and friction of a pose that was approached from both directions follow without a model
(`bands`): the mean of the two efforts is gravity, and half their difference is static friction.
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
    """Method for predicting the effort of a dwell.

    Attributes:
        key: Key of the method in the spec.
        words: Name of the method in the tables of results.
        estimator: Name under which the estimator is registered.
        params: Parameters of the estimator.
        grid: Candidate parameter sets, of which the set with the smallest error on inner held-out
            poses is selected.
        cost: Duration of a fit relative to the other methods.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    grid: tuple[Mapping[str, Any], ...] = ({},)
    cost: float = 1.0

    def candidates(self) -> tuple[Method, ...]:
        """Return the methods that result from the candidate parameter sets of the grid."""
        return tuple(
            replace(self, params={**self.params, **chosen}, grid=(chosen,)) for chosen in self.grid
        )


WEIGHT_DECAYS = (0.0, 1e-4, 1e-3)
"""Candidate values for the weight decay of the networks."""

NETWORK_COST = 10.0
"""Approximate training time of six networks with early stopping [s]."""


def known_methods(
    *, alpha: float, weights: str, layout: tuple[int, ...], epochs: int, seed: int
) -> dict[str, Method]:
    """Return all methods by key, from gravity only to the hysteresis model of this project."""
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
    """Data splits and fits of the honest protocol.

    Args:
        recording: Usable dwells of the run.
        methods: Methods that the protocol compares.
        folds: Number of cross-validation folds; each pose is held out in exactly one fold.
        hold_out_percent: Share of the poses [%] that a single split holds out; None selects
            cross-validation.
        seed: Random seed for splitting the poses.

    Raises:
        FitError: There are too few poses for the folds.
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
        """Return one task per fit, in the order in which `gather` reads the results."""
        return [
            task
            for method in self._methods
            for part in self._splits
            for task in fit_tasks(method, part.train, part.test, self._recording.robot)
        ]

    def gather(self, outcomes: Sequence[Outcome]) -> HonestRun:
        """Combine the results of the tasks returned by `tasks`.

        Raises:
            FitError: None of the methods could be fitted.
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
                notes.append(f"{method.words} ({method.estimator}) is omitted: {failed}")
            else:
                methods[method.key] = _joined(method, found, order)
        if not methods:
            raise FitError(
                f"no method could be fitted: {notes[0]}",
                hint="the page lists the other reasons; hil doctor lists missing packages",
            )
        measured = dwell_means(dwells, dwells["effort"])[numbers[order]]
        common = np.ones(measured.shape, dtype=bool)
        for one in methods.values():
            common &= np.isfinite(one.effort)
        unsaid = int(np.count_nonzero(~common.all(axis=1)))
        if unsaid:
            notes.append(
                f"{unsaid} of {len(common)} held-out dwells are not compared in every joint, "
                "because a method has no prediction for them (mostly the first dwell of a program, "
                "whose approach direction is unknown)"
            )
        noise = mean_noise(dwells)
        return HonestRun(
            dwells, numbers[order], measured, common, methods, count, noise, tuple(notes)
        )


LEAST_SAID = 0.5
"""Minimum share of the dwells that a method must predict to be compared with other methods."""


def _failure(found: Sequence[Outcome]) -> str:
    """Return the reason why a method cannot be compared; empty if it can be compared."""
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
    """Return the (S,) numbers of the dwells that a split holds out."""
    return np.asarray(dwells_in(part.test)[part.test.offsets[:-1]])


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Prediction of held-out dwells by one fit of one method.

    Attributes:
        effort: (S, n) predicted mean effort of each dwell; NaN if the model makes no prediction.
        std: (S, n) standard deviation of the prediction; NaN if the model does not predict it.
        own_error: Mean over the joints of the error that the model determined on poses held out of
            its training data, or on the training data if the model holds out none.
        seconds: CPU time of the fit on one core [s].
        failed: Reason why the fit failed; empty if the fit succeeded.
        chosen: Parameter set selected from the grid, as text; empty if the grid has only one set.
    """

    effort: FloatArray
    std: FloatArray
    own_error: float = np.inf
    seconds: float = 0.0
    failed: str = ""
    chosen: str = ""


def fit_tasks(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> list[Task]:
    """Return the tasks of a method, one task per candidate parameter set.

    Each task fits one candidate to the training dwells and predicts the effort of the test dwells.
    """
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
    # Estimators are plug-ins: an unexpected error of one must not discard the results of others.
    except Exception as error:
        words = f"it failed with {type(error).__name__}: {error}"
        return Outcome(nothing, nothing, failed=words)
    effort = dwell_means(test, np.where(predicted.valid, predicted.effort, np.nan))
    std = dwell_means(test, np.array(predicted.std))
    chosen = ", ".join(f"{name} {value:g}" for name, value in method.grid[0].items())
    return Outcome(effort, std, float(np.mean(model.sigma_)), seconds, "", chosen)


def best_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the outcome with the smallest inner error, with the total time of all candidates."""
    best = min(outcomes, key=lambda outcome: outcome.own_error)
    return replace(best, seconds=sum(outcome.seconds for outcome in outcomes))


Measure: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]

WITHIN = 1.96
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class HonestRun:
    """Results of the honest protocol.

    Attributes:
        dwells: All dwells of the run.
        judged_dwells: (S,) numbers of the held-out dwells.
        measured: (S, n) mean effort of each held-out dwell.
        common: (S, n) mask of values that every method predicts; only these values are compared.
        methods: Predictions of the methods that could be fitted, by method key.
        folds: Number of splits of the poses.
        noise: (n,) standard deviation of a dwell mean caused by the noise of the samples.
        notes: Texts that name omitted methods or dwells, with the reason.
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
        """Return the (n,) RMSE of a method on the held-out dwells."""
        return self._per_joint(lambda a, b: rmse(a, b), self.methods[key].effort)

    def correlation(self, key: str) -> FloatArray:
        """Return the (n,) correlation coefficient R of predicted and measured effort."""
        return self._per_joint(lambda a, b: correlation(a, b), self.methods[key].effort)

    def coverage(self, key: str) -> FloatArray:
        """Return the (n,) share of errors that are within ±1.96 predicted standard deviations.

        The share is NaN for a method that predicts no standard deviation.
        """
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
    """Predictions of one method for held-out dwells, in the row order of `HonestRun.measured`.

    Attributes:
        method: The method.
        effort: (S, n) predicted effort.
        std: (S, n) standard deviation of the prediction; NaN if the method does not predict it.
        seconds: Mean CPU time of a fit on one core, including tuning [s].
        chosen: Text that lists the parameter sets selected by nested validation, and the number of
            folds that selected each set.
    """

    method: Method
    effort: FloatArray
    std: FloatArray
    seconds: float
    chosen: str


GRAVITY = ("gravity", "gravity-paper", "wls", "ls", "ridge")
"""Keys of the methods without friction; the first fitted method represents pure gravity."""

FRICTION = ("coulomb", "network-approach", "hysteresis")
"""Keys of the methods that use the approach direction; the last method is that of this project."""

SHORT = {"coulomb": "Fc·sign", "network-approach": "network", "hysteresis": "ours"}


def bands(run: HonestRun) -> Bands | None:
    """Return measured and predicted effort of poses approached from both directions.

    None is returned if no pose was approached from both directions.
    """
    conditions = [run.dwells.conditions[number] for number in run.judged_dwells]
    both = pairs(tuple(conditions))
    if not both:
        return None
    predicted = {key: _sides(one.effort, both) for key, one in run.methods.items()}
    common = np.array([run.common[below + above].all(axis=0) for below, above in both])
    return Bands(_sides(run.measured, both), predicted, common, run.dwells.effort_unit)


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Measured and predicted effort per pose, for poses approached from both directions.

    Attributes:
        measured: Mean and half difference of the measured efforts.
        predicted: Mean and half difference of the efforts predicted for held-out poses, by method
            key.
        common: (P, n) mask of values for which every method predicts both approach directions.
        unit: Unit of the effort.
    """

    measured: Sides
    predicted: dict[str, Sides]
    common: BoolArray
    unit: str

    @property
    def load(self) -> FloatArray:
        """(P, n) magnitude of the effort without friction: mean of the two approach directions."""
        return np.abs(self.measured.mean)


@dataclass(frozen=True, slots=True, eq=False)
class Sides:
    """Mean and half difference of the efforts of the two approach directions, (P, n) each.

    Attributes:
        mean: Mean of the efforts approached from below and from above.
        half: Half of the effort difference, below minus above.
    """

    mean: FloatArray
    half: FloatArray


def _sides(values: FloatArray, both: list[tuple[list[int], list[int]]]) -> Sides:
    below = np.array([values[numbers].mean(axis=0) for numbers, _ in both])
    above = np.array([values[numbers].mean(axis=0) for _, numbers in both])
    return Sides((below + above) / 2, (below - above) / 2)


def gravity_of(found: Bands) -> str | None:
    """Return the key of the method that represents pure gravity; None if it was not fitted."""
    return next((key for key in GRAVITY if key in found.predicted), None)


def friction_of(found: Bands) -> list[str]:
    """Return the keys of fitted methods whose prediction depends on the approach direction."""
    return [key for key in FRICTION if key in found.predicted]
