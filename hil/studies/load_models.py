"""Models that a study of loads judges: on which motions, told what, and with which errors.

Each motion is judged once, by a model that was fitted to all the others (`Candidate`, fold by
fold): two motions of eight are few, and which two they are changes what a model seems to be worth
by a tenth or more. Under every load, the motions that are not judged are there to identify it
from (`LoadCase`). `judged` scores a model told nothing of the load, told what was declared, and
told what was identified, and checks the declarations.
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
"""An estimator by name, or with its parameters beside the key `estimator`."""


def estimator_of(entry: Entry) -> RobotEstimator:
    """An estimator as it is asked for, unfitted.

    Raises:
        PluginError, SpecError: There is no such estimator or parameter.
    """
    if isinstance(entry, str):
        return estimator(entry)
    params = dict(entry)
    return estimator(params.pop("estimator"), **params)


Fold = frozenset[Group]
"""Motions that are judged together."""

SHARE = 4
"""One motion of so many is judged at a time, where nobody says how many."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A way to get models of the bare arm.

    Attributes:
        name: For people.
        fitted: The model for a fold, which has seen nothing of it.
        folds: Those it can be judged on.
    """

    name: str
    fitted: Callable[[Fold], RobotEstimator]
    folds: tuple[Fold, ...]


def folds_of(every: Sequence[Group], first: Fold | None, size: int | None) -> tuple[Fold, ...]:
    """Every motion once, from the last ones to the first.

    Args:
        every: The motions.
        first: Those of the first fold, where that is given: as many make each other one.
        size: Motions of a fold; by default a quarter of them.

    Raises:
        FitError: Nothing would be left to fit to.
    """
    size = len(first) if first is not None else size or max(1, len(every) // SHARE)
    if size >= len(every):
        raise FitError(
            f"{size} of {len(every)} motions cannot be held out",
            hint="hold_out: fewer, so that some are left to fit to",
        )
    rest = [group for group in every if first is None or group not in first]
    parts = [rest[max(0, end - size) : end] for end in range(len(rest), 0, -size)]
    return (*([first] if first is not None else []), *map(frozenset, parts))


def fresh_models(
    entries: Sequence[Entry], data: Dataset, of: Recorded, robot: RobotModel, size: int | None
) -> tuple[Candidate, ...]:
    """Estimators that are fitted fold by fold, to the first load and with their own settings.

    Raises:
        PluginError, SpecError: There is no such estimator or parameter; nothing has been fitted.
        FitError: The motions are too few.
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
    """Networks train for minutes: they are judged on the first fold alone."""
    return folds[:1] if keeps_checkpoints(model) else folds


def _name(names: Sequence[str], i: int) -> str:
    return names[i] if names.count(names[i]) == 1 else f"{names[i]} ({i + 1})"


OTHER_MOTIONS = "record other motions, or fit with `validate: {hold_out: {trajectories: 3}}`"


def stored_models(
    models: Sequence[Path], data: Dataset, of: Recorded, robot: RobotModel, size: int | None
) -> tuple[Candidate, ...]:
    """Stored models; one of the run itself is fitted again for the motions it has seen.

    Raises:
        DataError: As `unseen`.
        FitError: The motions are too few.
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
    # Only a model fitted to all the rest of this run, and to nothing else, can be fitted again.
    of_one_source = bool(model.training_ and len(model.training_.sources) <= 1)
    whole = seen == set(groups(bare, "trajectory")) - left and of_one_source
    judged = _rotated(model, folds) if whole else folds[:1]
    return Candidate(name, lambda fold: model if fold <= left else again(fold), judged)


def unseen(
    models: Sequence[Path], of: Recorded
) -> tuple[list[tuple[str, RobotEstimator]], frozenset[Group]]:
    """Stored models with their names, and the motions of a run that none of them has seen.

    Args:
        models: Their folders; one that is not there is looked for in the run's.
        of: The run.

    Raises:
        DataError: One cannot be read or was fitted with another load, or there is no motion that
            none has seen.
    """
    stored = [(path, load_model_file(_place(path, of))) for path in models]
    for path, model in stored:
        if knows(model, _loaded(of)):
            raise DataError(
                f"{path} was fitted to recordings of this run with a load",
                hint="fit a model to the first load alone, or name an --estimator",
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
            f"no motion of this run is left to judge on: {told} "
            f"{'was' if len(models) == 1 else 'were'} fitted to all of them",
            hint=OTHER_MOTIONS,
        )
    return _named(stored), frozenset(fresh)


def _place(model: Path, of: Recorded) -> Path:
    in_run = Path(of.bare.data.conditions[0].source) / model
    return in_run if in_run.exists() and not model.exists() else model


def _named(stored: Sequence[tuple[Path, RobotEstimator]]) -> list[tuple[str, RobotEstimator]]:
    """By estimator; by folder where that is there twice."""
    names = [model.estimator for _, model in stored]
    return [
        (model.estimator if names.count(model.estimator) == 1 else path.name, model)
        for path, model in stored
    ]


def knows(model: RobotEstimator, data: Dataset) -> bool:
    """Whether a model was fitted to some of these samples."""
    return bool(model.training_ and model.training_.rows.share_known(data) > SAME_SHARE)


def motions_of(data: Dataset, wanted: AbstractSet[Group]) -> Dataset:
    """The recordings of some motions, under whatever load."""
    return data.select(lambda condition: group_of(condition, "trajectory") in wanted)


@dataclass(frozen=True, slots=True, eq=False)
class LoadCase:
    """One load of a run.

    Attributes:
        name: Such as `3 kg`.
        declared: As the run's spec has it.
        told: Motions to identify it from; None for the first load, under which models learn.
        judged: The motions held out, under this load.
    """

    name: str
    declared: Payload
    told: Dataset | None
    judged: Dataset


def load_cases(of: Recorded, held: frozenset[Group]) -> list[LoadCase]:
    """The first load, then the others.

    Raises:
        FitError: The run has no other load, or one of them not all the motions it takes.
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
                f"{names[load]}: no motion is left to "
                f"{'identify it from' if judged.conditions else 'judge on'}",
                hint="record every trajectory with every load",
            )
        told = downsample(told, of.bare.filters)
        cases.append(LoadCase(names[load], declared[load], told, judged))
    return cases


def _told_apart(names: dict[int, str]) -> dict[int, str]:
    """One mass mounted twice is two loads."""
    masses = list(names.values())
    return {
        load: name if masses.count(name) == 1 else f"{name} (load {load})"
        for load, name in names.items()
    }


def _loaded(of: Recorded) -> Dataset:
    if of.loaded is None:
        raise FitError(
            "the run has no load besides its first",
            hint="record one with several, as experiments/load_generalisation.yaml does",
        )
    return of.loaded


TOLD = ("unaware", "declared", "calibrated", "identified")
"""What the model is told of the load: nothing; what the spec says; the same, and how far the drive
gains are off as the other loads tell; what other motions with the load say."""


@dataclass(frozen=True, slots=True, eq=False)
class UnderLoads:
    """What a model is worth under every load of a run.

    Attributes:
        name: Of the model, for people.
        protocol: `honest`, or how its fit departs from that.
        loads: The first one, under which it was fitted, then the others; errors over all folds,
            loads as identified without the first one.
        folds: The same of every fold by itself.
    """

    name: str
    protocol: str
    loads: tuple[Scored, ...]
    folds: tuple[tuple[Scored, ...], ...]

    @staticmethod
    def of(name: str, protocol: str, folds: Sequence[tuple[Scored, ...]]) -> UnderLoads:
        """From the folds: squares of errors are averaged, motion by motion."""
        loads = tuple(_pooled(each) for each in zip(*folds, strict=True))
        return UnderLoads(name, protocol, loads, tuple(folds))

    def ratios(self, told: str = "declared") -> FloatArray:
        """(loads but the first,) error over that with the first load; NaN where not known.

        Both errors are means over the joints.
        """
        return _ratios(self.loads, told)

    def worst(self, told: str = "declared") -> tuple[Scored, float]:
        """The load told of which it errs most, and by how many times as much as with the first."""
        i, ratios = self._worst(told), self.ratios(told)
        return self.loads[1 + i], float(ratios[i])

    def spread(self, told: str = "declared") -> tuple[float, float]:
        """Smallest and largest of the folds' own ratios, under the worst load of all."""
        i = self._worst(told)
        each = [float(_ratios(fold, told)[i]) for fold in self.folds]
        return min(each), max(each)

    def _worst(self, told: str) -> int:
        return int(np.argmax(self.ratios(told)))  # a NaN counts as the largest

    def contradicted(self) -> tuple[str, ...]:
        """Loads whose declaration is contradicted, or could not be checked."""
        others = (one for one in self.loads if one.case.told is not None)
        return tuple(one.case.name for one in others if one.check is None or not one.check.agrees)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """One load.

    Attributes:
        case: Its recordings.
        errors: By `TOLD`, (n,) RMSE in N·m on the motions held out; without `identified` where
            there is no estimate, and without `calibrated` where no other load tells gains.
        estimate: The identified load; None for the first one, and where it failed.
        failed: Why it did.
        check: The declaration against it; None without an estimate, or where nobody asked.
    """

    case: LoadCase
    errors: Mapping[str, FloatArray]
    estimate: PayloadEstimate | None = None
    failed: str = ""
    check: Declaration | None = None


def _pooled(folds: Sequence[Scored]) -> Scored:
    """One load over all folds."""
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
    """One fold: errors under every load, and every declaration against what was identified.

    Args:
        model: Fitted without any of it.
        cases: The loads, the first one first.
        scale: (n,) torque per unit of effort.
        friction: See `estimate_payload`.
        false_alarm: See `check_declarations`.
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
    """A load's errors; an estimate that fails is told, not raised."""
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
    """With its declaration judged, and its error where gains are as the other loads tell."""
    errors = dict(one.errors)
    if np.any(check.gains):
        data = one.case.judged
        bare, declared = (_effort(model, data, load) for load in (Payload(), one.case.declared))
        # A larger gain makes the same torque of the load from less current.
        effort = bare + (declared - bare) / (1.0 + check.gains)
        errors["calibrated"] = _error(data, effort, scale)
    return replace(one, errors=errors, check=check)


def _effort(model: RobotEstimator, data: Dataset, load: Payload) -> FloatArray:
    """(N, n) effort; NaN where the model does not vouch for it."""
    predicted = model.predict(with_identified(data, load))
    return np.where(predicted.valid, predicted.effort, np.nan)


def _error(data: Dataset, effort: FloatArray, scale: FloatArray) -> FloatArray:
    return rmse_where(data["effort_f"] * scale, effort * scale, np.isfinite(effort))
