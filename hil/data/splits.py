"""Splits of a dataset into training and test data, and detection of shared samples.

Neighbouring samples of one motion are nearly equal. A model is therefore evaluated on groups of
samples that were not used in the fit. `split` and `kfold` keep whole trajectories, poses or
payloads together, and `assert_disjoint` rejects training and test data that share a group or
samples. The by-sample split of the static and the PINN paper exists only as `paper_sample_split`.

A fit with early stopping also needs validation rows: `training_and_validation` holds out whole
trajectories of the training data. A study that reproduces a publication marks single rows in the
column `PART` instead, so that windows and friction states are still computed along whole motions.
Estimators then do not use the rows that are marked `TEST`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, IntArray
from hil.data.dataset import AT_REST, Conditions, Dataset, rows_of
from hil.data.fingerprints import fingerprints

SplitBy = Literal["trajectory", "pose", "load"]
Group: TypeAlias = tuple[str, int]
"""Source and index of a trajectory or pose; a payload has an empty source."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Training and test data that have no group in common.

    Attributes:
        train: Series of the groups used in the fit.
        test: Series of the groups used in the evaluation.
        by: Kind of the groups (trajectory, pose or payload).
        held_out: List of the groups in `test`.
    """

    train: Dataset
    test: Dataset
    by: SplitBy
    held_out: tuple[Group, ...]


def group_of(condition: Conditions, by: SplitBy) -> Group | None:
    """Return the group of a series; None if the series has no group, such as a warm-up.

    Poses and trajectories are numbered within their source, whereas payload numbers are the same in
    all sources.
    """
    if by == "load":
        return ("", condition.load)
    number: int = getattr(condition, by)
    return (condition.source, number) if number >= 0 else None


def groups(dataset: Dataset, by: SplitBy) -> tuple[Group, ...]:
    """Return the distinct groups of a dataset, in the order of appearance."""
    every = (group_of(condition, by) for condition in dataset.conditions)
    return tuple(dict.fromkeys(group for group in every if group is not None))


def split(
    dataset: Dataset,
    by: SplitBy,
    test: int | float | Sequence[int] = 0.2,
    seed: int = 0,
) -> Split:
    """Return the dataset split into training and test data, with whole groups held out.

    Args:
        dataset: Dataset to split; series without a group are in neither part.
        by: Kind of the groups that stay together. If poses are the groups, both approach directions
            and all payloads of a pose stay together.
        test: Number of groups to hold out (int), share of the groups (float below 1), or list of
            group numbers. With the share 0, no group is held out; any other share holds out at
            least one group.
        seed: Seed of the random choice of groups; not used if group numbers are passed.

    Raises:
        DataError: There are not enough groups, or a group number does not exist.
    """
    every = groups(dataset, by)
    if isinstance(test, int | float):
        held_out = _draw(every, by, test, seed)
    else:
        held_out = _numbered(every, by, test)
    if held_out and len(held_out) == len(every):
        raise DataError(
            f"no data are left for the fit: all {by} groups are held out",
            hint="hold out fewer, or record more",
        )
    return _split_at(dataset, by, held_out)


def _draw(every: Sequence[Group], by: SplitBy, test: float, seed: int) -> tuple[Group, ...]:
    if test == 0:
        return ()
    count = int(test) if test >= 1 else max(1, round(test * len(every)))
    if test < 0 or count >= len(every):
        raise DataError(
            f"cannot hold out {test if test < 0 else count} of {len(every)} {by} group(s)",
            hint=f"the data needs at least {max(1, count) + 1} different {by} groups",
        )
    chosen = np.random.default_rng(seed).choice(len(every), count, replace=False)
    return tuple(every[i] for i in np.sort(chosen))


def _numbered(every: Sequence[Group], by: SplitBy, numbers: Sequence[int]) -> tuple[Group, ...]:
    held_out = tuple(group for group in every if group[1] in set(numbers))
    unknown = sorted(set(numbers) - {number for _, number in held_out})
    if unknown:
        known = sorted({number for _, number in every})
        raise DataError(f"no {by} {unknown[0]} in the data", hint=f"there are {known}")
    return held_out


def _split_at(dataset: Dataset, by: SplitBy, held_out: tuple[Group, ...]) -> Split:
    chosen = set(held_out)
    test = dataset.select(lambda condition: group_of(condition, by) in chosen)
    train = dataset.select(lambda condition: group_of(condition, by) not in chosen | {None})
    return Split(train, test, by, held_out)


def kfold(dataset: Dataset, by: SplitBy, folds: int, seed: int = 0) -> Iterator[Split]:
    """Yield `folds` splits with disjoint test parts, which together contain every group once.

    Raises:
        DataError: There are fewer groups than folds.
    """
    every = groups(dataset, by)
    if not 2 <= folds <= len(every):
        raise DataError(
            f"{folds} folds are not possible with {len(every)} {by} group(s)",
            hint="choose at least 2 folds and at most one per group",
        )
    order = np.random.default_rng(seed).permutation(len(every))
    for part in np.array_split(order, folds):
        yield _split_at(dataset, by, tuple(every[i] for i in np.sort(part)))


SAME_SHARE = 0.01
"""Maximum share of distinct samples that independent recordings have in common by chance."""


def assert_disjoint(train: Dataset, test: Dataset) -> None:
    """Raise if a test set shares a pose, a trajectory or samples with the training set.

    Training and test data may share payloads. Samples are compared by position and effort, not by
    time. A recording that was imported twice under different names, or with a shifted clock, is
    therefore detected too. Up to 1 % of the distinct samples may be equal, as in noise-free
    simulations with a common start.

    The same *program* recorded twice is accepted, because the samples of the two recordings differ;
    see `hil.data.revisited`.

    Raises:
        DataError: A group or samples are shared; the message names the shared groups or samples.
    """
    by_kind: tuple[SplitBy, ...] = ("trajectory", "pose")
    for by in by_kind:
        shared = set(groups(train, by)) & set(groups(test, by))
        if shared:
            source, number = min(shared)
            raise DataError(
                f"{len(shared)} {by} group(s) are in both training and test data, "
                f"the first is {by} {number} of {source or 'the data'}",
                hint="hold out whole groups: another run (--validate RUN), validate.hold_out in a "
                "spec, or hil.data.split(dataset, by=…) in Python",
            )
    rows = fingerprints(test)
    same = rows[np.isin(rows, fingerprints(train))]
    if len(same) > SAME_SHARE * len(rows):
        ours, theirs = _sources_with(same, test), _sources_with(same, train)
        raise DataError(
            f"{len(same)} samples of the test data are also in the training data"
            + (f": those of {ours} in {theirs}" if ours and theirs else ""),
            hint="the same recording was passed twice, or a mock robot repeated a run with the "
            "same seed: record the second with a different excitation.seed",
        )


def _sources_with(rows: IntArray, data: Dataset) -> str:
    """Return the names of the sources that contain the fingerprints; empty if they have no name."""
    named = []
    for source in dict.fromkeys(condition.source for condition in data.conditions):
        here = [k for k, condition in enumerate(data.conditions) if condition.source == source]
        part = data.take(here)
        if source and np.isin(rows, fingerprints(part)).any():
            named.append(source)
    return " and ".join(named)


def paper_sample_split(
    dataset: Dataset, shares: tuple[float, float, float] = (0.75, 0.20, 0.05), seed: int = 0
) -> tuple[Dataset, Dataset, Dataset]:
    """Return a random split by *sample*, which serves only to reproduce results of the papers.

    With a split by sample, samples of the same pose or instant are in several parts; therefore,
    errors measured with this split do not show the accuracy for new poses or motions
    (docs/explanation/honest-protocols.md). After a split by sample, the series contain gaps and
    cannot be filtered, so the dataset must be prepared before the split.
    """
    kinds = np.random.default_rng(seed).choice(3, size=len(dataset), p=np.asarray(shares))
    first, second, third = (rows_of(dataset, kinds == part) for part in range(3))
    return first, second, third


# Training, validation and test rows


PART = "part"
"""Name of the column (N,) whose values are `TRAINING`, `VALIDATION` or `TEST`."""

TRAINING, VALIDATION, TEST = 0.0, 1.0, 2.0

SAMPLE_SPLIT_PROTOCOL = "paper: rows of the same motions to learn from and to judge"
"""Protocol of a model whose data have a by-sample split (`has_sample_split`)."""


def with_part(dataset: Dataset, part: FloatArray) -> Dataset:
    """Return the dataset with the additional column `PART` (N,)."""
    return dataset.with_columns(**{PART: np.asarray(part, dtype=np.float64)})


def has_sample_split(dataset: Dataset) -> bool:
    """Return whether the column `PART` assigns rows of one motion to different parts."""
    if PART not in dataset.columns:
        return False
    motions = (rows for condition, rows in dataset.slices() if condition.kind not in AT_REST)
    return any(len(np.unique(dataset[PART][rows])) > 1 for rows in motions)


def rows_to_fit(dataset: Dataset) -> BoolArray:
    """Return (N,) a mask of the rows for estimators without early stopping: all but test rows."""
    if PART in dataset.columns:
        return np.asarray(dataset[PART] != TEST)
    return np.ones(len(dataset), dtype=bool)


def training_and_validation(
    dataset: Dataset, share: float = 2 / 9, seed: int = 0
) -> tuple[BoolArray, BoolArray]:
    """Return two masks (N,): training rows and validation rows; a row may be in neither.

    Args:
        dataset: Dataset to divide; if the dataset has the column `PART`, this column alone defines
            the rows.
        share: Share of the trajectories that is held out for validation, at least one trajectory.
            If there is a single trajectory, its end is held out.
        seed: Seed of the random choice of trajectories.

    Raises:
        DataError: One of the two masks would contain no rows.
    """
    if PART in dataset.columns:
        train, validate = dataset[PART] == TRAINING, dataset[PART] == VALIDATION
    elif len(groups(dataset, "trajectory")) > 1:
        held_out = set(split(dataset, "trajectory", share, seed).held_out)
        validate = np.zeros(len(dataset), dtype=bool)
        for condition, rows in dataset.slices():
            validate[rows] = group_of(condition, "trajectory") in held_out
        train = ~validate
    else:
        train, validate = _beginning_and_end(dataset)
    if not (np.any(train) and np.any(validate)):
        raise DataError(
            "no rows are left for training"
            if not np.any(train)
            else "no rows are left for early stopping",
            hint="pass at least two trajectories, or a longer one",
        )
    return train, validate


_END_SHARE = 0.2
"""Share at the end of a single trajectory that is used as validation data."""

_GAP_SHARE = 0.02
"""Share of a single trajectory that is not used, between training and validation rows.

The gap between training and validation rows is needed, because samples that are close in time are
nearly equal.
"""


def _beginning_and_end(dataset: Dataset) -> tuple[BoolArray, BoolArray]:
    train, validate = (np.zeros(len(dataset), dtype=bool) for _ in range(2))
    for condition, rows in dataset.slices():
        if condition.kind in AT_REST:
            continue
        count = rows.stop - rows.start
        first = rows.start + int((1.0 - _END_SHARE) * count)
        train[rows.start : first - int(_GAP_SHARE * count)] = True
        validate[first : rows.stop] = True
    return train, validate
