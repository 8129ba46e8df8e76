"""Motions a study of loads fits to, identifies each load from, and judges on: never the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path

from hil.arms import Payload
from hil.core import DataError, FitError
from hil.data import SAME_SHARE, Dataset, FilterSettings, Group, downsample, group_of, groups
from hil.estimators import RobotEstimator, load_model_file
from hil.studies.inverse_cases import Recorded, load_names
from hil.studies.separation_text import listed

OTHER_MOTIONS = "record other motions, or fit with `validate: {hold_out: {trajectories: 3}}`"


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


def load_cases(of: Recorded, held: frozenset[Group]) -> list[LoadCase]:
    """The first load, then the others.

    Raises:
        FitError: The run has no other load, or one of them not all the motions it takes.
    """
    bare, loaded = of.bare.data, _loaded(of)
    first = next(iter(bare.conditions))
    names = _told_apart(load_names(bare) | load_names(loaded))
    cases = [LoadCase(names[first.load], first.payload, None, motions_of(bare, held))]
    return [*cases, *_others(loaded, held, of.bare.filters, names)]


def _told_apart(names: dict[int, str]) -> dict[int, str]:
    """One mass mounted twice is two loads."""
    masses = list(names.values())
    return {
        load: name if masses.count(name) == 1 else f"{name} (load {load})"
        for load, name in names.items()
    }


def _others(
    loaded: Dataset, held: frozenset[Group], filters: FilterSettings, names: dict[int, str]
) -> Iterator[LoadCase]:
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
        yield LoadCase(names[load], declared[load], downsample(told, filters), judged)


def _loaded(of: Recorded) -> Dataset:
    if of.loaded is None:
        raise FitError(
            "the run has no load besides its first",
            hint="record one with several, as experiments/load_generalisation.yaml does",
        )
    return of.loaded


def motions_of(data: Dataset, wanted: AbstractSet[Group]) -> Dataset:
    """The recordings of some motions, under whatever load."""
    return data.select(lambda condition: group_of(condition, "trajectory") in wanted)


def knows(model: RobotEstimator, data: Dataset) -> bool:
    """Whether a model was fitted to some of these samples."""
    return bool(model.training_ and model.training_.rows.share_known(data) > SAME_SHARE)
