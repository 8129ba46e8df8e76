"""Models that a study of loads judges, and how often: fold by fold, on motions they have not seen.

Two motions of eight are few: which two they are changes what a model seems to be worth by a tenth
or more. So each motion is judged once, by a model that was fitted to all the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hil.core import FitError
from hil.data import Dataset, Group, assert_disjoint, group_of, groups
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator, estimator
from hil.networks import keeps_checkpoints
from hil.studies.inverse_cases import Recorded
from hil.studies.load_cases import knows, motions_of, unseen

Fold = frozenset[Group]
"""Motions that are judged together."""

Entry = str | Mapping[str, Any]
"""An estimator by name, or with its parameters beside the key `estimator`."""

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


def fresh(
    entries: Sequence[Entry], data: Dataset, of: Recorded, robot: RobotModel, size: int | None
) -> tuple[Candidate, ...]:
    """Estimators that are fitted fold by fold, to the first load and with their own settings.

    Raises:
        PluginError, SpecError: There is no such estimator or parameter; nothing has been fitted.
        FitError: The motions are too few.
    """
    every = groups(of.bare.data, "trajectory")
    folds = folds_of(every, None, size)
    unfitted = [made(entry) for entry in entries]
    names = [one.estimator for one in unfitted]
    return tuple(
        Candidate(_name(names, i), partial(_fit, one, data, of, robot), _rotated(one, folds))
        for i, one in enumerate(unfitted)
    )


def stored(
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


def made(entry: Entry) -> RobotEstimator:
    """An estimator as it is asked for, unfitted.

    Raises:
        PluginError, SpecError: There is no such estimator or parameter.
    """
    if isinstance(entry, str):
        return estimator(entry)
    params = dict(entry)
    return estimator(params.pop("estimator"), **params)


def _of_stored(
    name: str, model: RobotEstimator, folds: tuple[Fold, ...], left: Fold, data: Dataset,
    of: Recorded, robot: RobotModel,
) -> Candidate:  # fmt: skip
    bare = of.bare.data
    seen = {one for one in groups(bare, "trajectory") if knows(model, motions_of(bare, {one}))}
    if not seen:
        return Candidate(name, lambda fold: model, folds)
    again = partial(_fit, model, data, of, robot)
    whole = seen == set(groups(bare, "trajectory")) - left and _of_one_source(model)
    judged = _rotated(model, folds) if whole else folds[:1]
    return Candidate(name, lambda fold: model if fold <= left else again(fold), judged)


def _of_one_source(model: RobotEstimator) -> bool:
    return bool(model.training_ and len(model.training_.sources) <= 1)


def _rotated(model: RobotEstimator, folds: tuple[Fold, ...]) -> tuple[Fold, ...]:
    """Networks train for minutes: they are judged on the first fold alone."""
    return folds[:1] if keeps_checkpoints(model) else folds


def _name(names: Sequence[str], i: int) -> str:
    return names[i] if names.count(names[i]) == 1 else f"{names[i]} ({i + 1})"


def _fit(
    like: RobotEstimator, data: Dataset, of: Recorded, robot: RobotModel, fold: Fold
) -> RobotEstimator:
    first = of.bare.data.conditions[0].load
    bare = data.of_kind("trajectory").select(lambda condition: condition.load == first)
    learn = bare.select(lambda condition: group_of(condition, "trajectory") not in fold | {None})
    assert_disjoint(learn, motions_of(of.bare.data, fold))
    return type(like)(**like.get_params()).fit(learn, robot)
