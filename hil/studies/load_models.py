"""Models and data of the load-validation study: folds, payload information, and prediction errors.

Each motion is used for testing in exactly one fold, with a model that was fitted to all other
motions (`Candidate`, one fit per fold). A single split would be unreliable: if two of eight motions
are held out, the choice of these two motions changes the error by 10 % or more. For every payload,
the motions that are not held out are used to identify the payload (`LoadCase`). `judged` computes
the errors of a model without payload information, with the declared payload, and with the
identified payload. `judged` also checks the declared payloads against the identified payloads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray
from hil.data import (
    SAME_SHARE,
    Dataset,
    Group,
    assert_disjoint,
    downsample,
    group_of,
    groups,
)
from hil.dynamics import RobotModel
from hil.estimators import (
    Declaration,
    Friction,
    PayloadEstimate,
    RobotEstimator,
    check_declarations,
    estimate_payload,
    estimator,
    load_model_file,
    with_identified,
)
from hil.networks import keeps_checkpoints
from hil.studies.dynamic_methods import rmse_where
from hil.studies.inverse_cases import Recorded, load_names
from hil.studies.result import listed, mean_of

Entry = str | Mapping[str, Any]
"""Name of an estimator, or mapping of its parameters that contains the estimator name under the key
`estimator`.
"""


def estimator_of(entry: Entry) -> RobotEstimator:
    """Return an unfitted estimator with the requested parameters.

    Raises:
        PluginError, SpecError: The estimator or one of its parameters does not exist.
    """
    if isinstance(entry, str):
        return estimator(entry)
    params = dict(entry)
    return estimator(params.pop("estimator"), **params)


Fold = frozenset[Group]
"""Names of the motions that are held out together."""

SHARE = 4
"""Default number of folds: one of four motions is held out at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Source of fitted models of the arm with the first payload.

    Attributes:
        name: Display name.
        fitted: Function that returns the model for a fold; the motions of the fold are not part of
            its training data.
        folds: Folds on which the candidate can be tested.
    """

    name: str
    fitted: Callable[[Fold], RobotEstimator]
    folds: tuple[Fold, ...]


def folds_of(every: Sequence[Group], first: Fold | None, size: int | None) -> tuple[Fold, ...]:
    """Divide the motions into folds, starting with the last motions; each motion is in one fold.

    Args:
        every: All motions.
        first: Motions of the first fold, whose size also sets the size of the other folds; None if
            the first fold can be chosen freely.
        size: Number of motions per fold; by default a quarter of the motions.

    Raises:
        FitError: No motion would remain for training.
    """
    size = len(first) if first is not None else size or max(1, len(every) // SHARE)
    if size >= len(every):
        raise FitError(
            f"{size} of {len(every)} motions cannot be held out",
            hint="reduce hold_out, so that motions remain for the fit",
        )
    rest = [group for group in every if first is None or group not in first]
    parts = [rest[max(0, end - size) : end] for end in range(len(rest), 0, -size)]
    return (*([first] if first is not None else []), *map(frozenset, parts))


def fresh_models(
    entries: Sequence[Entry], data: Dataset, of: Recorded, robot: RobotModel, size: int | None
) -> tuple[Candidate, ...]:
    """Return candidates that are fitted once per fold to data with the first payload.

    Raises:
        PluginError, SpecError: An estimator or a parameter does not exist; in this case, no model
            has been fitted.
        FitError: There are too few motions for the folds.
    """
    every = groups(of.bare.data, "trajectory")
    folds = folds_of(every, None, size)
    unfitted = [estimator_of(entry) for entry in entries]
    names = [one.estimator for one in unfitted]
    return tuple(
        Candidate(_name(names, i), partial(_fit, one, data, of, robot), _rotated(one, folds))
        for i, one in enumerate(unfitted)
    )


def _fit(
    like: RobotEstimator, data: Dataset, of: Recorded, robot: RobotModel, fold: Fold
) -> RobotEstimator:
    first = of.bare.data.conditions[0].load
    bare = data.of_kind("trajectory").select(lambda condition: condition.load == first)
    learn = bare.select(lambda condition: group_of(condition, "trajectory") not in fold | {None})
    assert_disjoint(learn, motions_of(of.bare.data, fold))
    return type(like)(**like.get_params()).fit(learn, robot)


def _rotated(model: RobotEstimator, folds: tuple[Fold, ...]) -> tuple[Fold, ...]:
    """Return the folds on which a model is tested.

    Networks are tested on the first fold only, because their training takes minutes.
    """
    return folds[:1] if keeps_checkpoints(model) else folds


def _name(names: Sequence[str], i: int) -> str:
    return names[i] if names.count(names[i]) == 1 else f"{names[i]} ({i + 1})"


OTHER_MOTIONS = "record other motions, or fit with `validate: {hold_out: {trajectories: 3}}`"


def stored_models(
    models: Sequence[Path], data: Dataset, of: Recorded, robot: RobotModel, size: int | None
) -> tuple[Candidate, ...]:
    """Return candidates for models that are stored in files.

    A model that was fitted to this run is fitted again without the motions of the fold. The fitted
    model is then tested on these motions.

    Raises:
        DataError: The files of a model cannot be read, or the model cannot be used (see `unseen`).
        FitError: There are too few motions for the folds.
    """
    found, left = unseen(models, of)
    every = groups(of.bare.data, "trajectory")
    first = None if len(left) == len(every) else left
    folds = folds_of(every, first, size)
    return tuple(_of_stored(name, model, folds, left, data, of, robot) for name, model in found)


def _of_stored(
    name: str, model: RobotEstimator, folds: tuple[Fold, ...], left: Fold, data: Dataset,
    of: Recorded, robot: RobotModel,
) -> Candidate:  # fmt: skip
    bare = of.bare.data
    seen = {one for one in groups(bare, "trajectory") if knows(model, motions_of(bare, {one}))}
    if not seen:
        return Candidate(name, lambda fold: model, folds)
    again = partial(_fit, model, data, of, robot)
    # Only a model fitted to the rest of this run and to no other data can be fitted again.
    of_one_source = bool(model.training_ and len(model.training_.sources) <= 1)
    whole = seen == set(groups(bare, "trajectory")) - left and of_one_source
    judged = _rotated(model, folds) if whole else folds[:1]
    return Candidate(name, lambda fold: model if fold <= left else again(fold), judged)


def unseen(
    models: Sequence[Path], of: Recorded
) -> tuple[list[tuple[str, RobotEstimator]], frozenset[Group]]:
    """Return stored models with their names, and the motions to which no model was fitted.

    Args:
        models: Paths of model folders; a path that does not exist is searched for in the run
            directory.
        of: Trajectories of the run on which the models are tested.

    Raises:
        DataError: The files of a model cannot be read, a model was fitted to data of the run with a
            different payload, or all motions were used for fitting.
    """
    stored = [(path, load_model_file(_place(path, of))) for path in models]
    for path, model in stored:
        if knows(model, _loaded(of)):
            raise DataError(
                f"{path} was fitted to recordings of this run with a load",
                hint="fit a model to the first load only, or name an --estimator",
            )
    bare = of.bare.data
    fresh = [
        group
        for group in groups(bare, "trajectory")
        if not any(knows(one, motions_of(bare, {group})) for _, one in stored)
    ]
    if not fresh:
        told = listed([str(path) for path in models])
        raise DataError(
            f"no motion of this run remains for evaluation: {told} "
            f"{'was' if len(models) == 1 else 'were'} fitted to all motions",
            hint=OTHER_MOTIONS,
        )
    return _named(stored), frozenset(fresh)


def _place(model: Path, of: Recorded) -> Path:
    in_run = Path(of.bare.data.conditions[0].source) / model
    return in_run if in_run.exists() and not model.exists() else model


def _named(stored: Sequence[tuple[Path, RobotEstimator]]) -> list[tuple[str, RobotEstimator]]:
    """Return the models by estimator name, or by folder name if estimator names are equal."""
    names = [model.estimator for _, model in stored]
    return [
        (model.estimator if names.count(model.estimator) == 1 else path.name, model)
        for path, model in stored
    ]


def knows(model: RobotEstimator, data: Dataset) -> bool:
    """Return whether a model was fitted to at least one of the samples."""
    return bool(model.training_ and model.training_.rows.share_known(data) > SAME_SHARE)


def motions_of(data: Dataset, wanted: AbstractSet[Group]) -> Dataset:
    """Return the recordings of the selected motions with all payloads."""
    return data.select(lambda condition: group_of(condition, "trajectory") in wanted)


@dataclass(frozen=True, slots=True, eq=False)
class LoadCase:
    """Data of the motions with one payload of a run.

    Attributes:
        name: Display name of the payload, such as `3 kg`.
        declared: Payload as declared in the spec of the run.
        told: Motions for identifying the payload; None for the first payload, with which the models
            are fitted.
        judged: Held-out motions with this payload, for testing the models.
    """

    name: str
    declared: Payload
    told: Dataset | None
    judged: Dataset


def load_cases(of: Recorded, held: frozenset[Group]) -> list[LoadCase]:
    """Return the data of the first payload, followed by the data of the other payloads.

    Raises:
        FitError: The run has no second payload, or a payload lacks motions for identification or
            testing.
    """
    bare, loaded = of.bare.data, _loaded(of)
    first = next(iter(bare.conditions))
    names = _told_apart(load_names(bare) | load_names(loaded))
    cases = [LoadCase(names[first.load], first.payload, None, motions_of(bare, held))]
    declared = {condition.load: condition.payload for condition in loaded.conditions}
    for load in sorted(declared):
        own = [i for i, condition in enumerate(loaded.conditions) if condition.load == load]
        data = loaded.take(own)
        judged = motions_of(data, held)
        told = motions_of(data, frozenset(groups(data, "trajectory")) - held)
        if not judged.conditions or not told.conditions:
            raise FitError(
                f"{names[load]}: no motion remains for "
                f"{'its identification' if judged.conditions else 'the evaluation'}",
                hint="record every trajectory with every load",
            )
        told = downsample(told, of.bare.filters)
        cases.append(LoadCase(names[load], declared[load], told, judged))
    return cases


def _told_apart(names: dict[int, str]) -> dict[int, str]:
    """Return unique payload names; payloads of equal mass get the payload number as a suffix."""
    masses = list(names.values())
    return {
        load: name if masses.count(name) == 1 else f"{name} (load {load})"
        for load, name in names.items()
    }


def _loaded(of: Recorded) -> Dataset:
    if of.loaded is None:
        raise FitError(
            "the run has only one load",
            hint="record a run with several loads, as experiments/load_generalisation.yaml does",
        )
    return of.loaded


TOLD = ("unaware", "declared", "calibrated", "identified")
"""Information about the payload that is passed to a model.

`unaware`: none. With `declared`, the model receives the payload in the spec. With `calibrated`, the
model receives the payload in the spec, and its drive gains are corrected by means of the other
payloads. With `identified`, the model receives the payload identified from other motions.
"""


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoads:
    """Prediction errors of one model with every payload of a run.

    Attributes:
        name: Display name of the model.
        protocol: `honest`, or a description of how the fit departs from the honest protocol.
        loads: Results for the first payload, with which the model was fitted, and for the other
            payloads. Prediction errors are pooled over all folds; the identified payloads are those
            of the first fold.
        folds: Separate results of every fold.
    """

    name: str
    protocol: str
    loads: tuple[Scored, ...]
    folds: tuple[tuple[Scored, ...], ...]

    @staticmethod
    def of(name: str, protocol: str, folds: Sequence[tuple[Scored, ...]]) -> UnderLoads:
        """Combine the results of all folds into one result.

        Squared errors are averaged over the folds, weighted by their number of samples.
        """
        loads = tuple(_pooled(each) for each in zip(*folds, strict=True))
        return UnderLoads(name, protocol, loads, tuple(folds))

    def ratios(self, told: str = "declared") -> FloatArray:
        """Return the (payloads − 1,) ratios of each error to the error with the first payload.

        The two errors of a ratio are means over the joints. The ratio of an unknown error is NaN.
        """
        return _ratios(self.loads, told)

    def worst(self, told: str = "declared") -> tuple[Scored, float]:
        """Return the payload with the largest error ratio, and this ratio."""
        i, ratios = self._worst(told), self.ratios(told)
        return self.loads[1 + i], float(ratios[i])

    def spread(self, told: str = "declared") -> tuple[float, float]:
        """Return the smallest and the largest error ratio of the folds, for the worst payload."""
        i = self._worst(told)
        each = [float(_ratios(fold, told)[i]) for fold in self.folds]
        return min(each), max(each)

    def _worst(self, told: str) -> int:
        return int(np.argmax(self.ratios(told)))  # a NaN counts as the largest

    def contradicted(self) -> tuple[str, ...]:
        """Return the names of payloads whose declaration is contradicted or was not checkable."""
        others = (one for one in self.loads if one.case.told is not None)
        return tuple(one.case.name for one in others if one.check is None or not one.check.agrees)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Prediction errors and payload check for one payload.

    Attributes:
        case: Data of the motions with this payload.
        errors: (n,) RMSE [N·m] on the held-out motions, by kind of payload information (keys of
            `TOLD`). The key `identified` is missing without an estimate; the key `calibrated` is
            missing if no other payload determines the drive gains.
        estimate: Identified payload; None for the first payload and for a failed identification.
        failed: Reason why the payload could not be identified; empty if it was identified.
        check: Comparison of the declared and the identified payload; None without an estimate or
            without a check.
    """

    case: LoadCase
    errors: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    failed: str = ""
    check: Declaration | None = None


def _pooled(folds: Sequence[Scored]) -> Scored:
    """Return the prediction errors with one payload, combined over all folds."""
    rows = [len(fold.case.judged) for fold in folds]
    errors = {
        told: np.sqrt(np.average([fold.errors[told] ** 2 for fold in folds], axis=0, weights=rows))
        for told in TOLD
        if all(told in fold.errors for fold in folds)
    }
    failed = next((fold.failed for fold in folds if fold.failed), "")
    return replace(folds[0], errors=errors, failed=failed)


def _ratios(loads: Sequence[Scored], told: str) -> FloatArray:
    bare = mean_of(loads[0].errors["declared"])
    others = [mean_of(one.errors[told]) if told in one.errors else np.nan for one in loads[1:]]
    return np.array(others) / bare


def judged(
    model: RobotEstimator,
    cases: Sequence[LoadCase],
    scale: FloatArray,
    friction: Friction | Literal["auto"],
    false_alarm: float,
) -> tuple[Scored, ...]:
    """Return the results of one fold: errors with every payload, and checks of the declarations.

    Args:
        model: Model that was fitted without the data in `cases`.
        cases: Data of the payloads, starting with the first payload.
        scale: (n,) torque per unit of effort.
        friction: Friction treatment, as in `estimate_payload`.
        false_alarm: False-alarm rate of the payload check, as in `check_declarations`.
    """
    loads = [_scored(model, case, scale, friction) for case in cases]
    known = [one for one in loads if one.estimate is not None]
    declared = [one.case.declared for one in known]
    estimates = [one.estimate for one in known if one.estimate is not None]
    checks = iter(check_declarations(declared, estimates, false_alarm=false_alarm))
    return tuple(
        one if one.estimate is None else _checked(model, one, next(checks), scale) for one in loads
    )


def _scored(
    model: RobotEstimator, case: LoadCase, scale: FloatArray, friction: Friction | Literal["auto"]
) -> Scored:
    """Return the errors with one payload; a failed identification is returned, not raised."""
    loads = {"unaware": Payload(), "declared": case.declared}
    found, failed = None, ""
    if case.told is not None:
        try:
            found = estimate_payload(model, case.told, friction=friction)
            loads["identified"] = found.payload
        except FitError as error:
            failed = error.message
    errors = {
        told: _error(case.judged, _effort(model, case.judged, load), scale)
        for told, load in loads.items()
    }
    return Scored(case, errors, found, failed)


def _checked(model: RobotEstimator, one: Scored, check: Declaration, scale: FloatArray) -> Scored:
    """Return the results with the payload check and the error with corrected drive gains added."""
    errors = dict(one.errors)
    if np.any(check.gains):
        data = one.case.judged
        bare, declared = (_effort(model, data, load) for load in (Payload(), one.case.declared))
        # With a larger drive gain, less current produces the same torque.
        effort = bare + (declared - bare) / (1.0 + check.gains)
        errors["calibrated"] = _error(data, effort, scale)
    return replace(one, errors=errors, check=check)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """Return the (N, n) predicted effort, with NaN in rows that the model marks as invalid."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _error(data: Dataset, effort: FloatArray, scale: FloatArray) -> FloatArray:
    return rmse_where(data["effort_f"] * scale, effort * scale, np.isfinite(effort))
