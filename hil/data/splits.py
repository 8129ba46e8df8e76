"""Splits of a dataset into what is fitted on and what is judged, and a guard against leaks.

Neighbouring samples of one motion are nearly the same sample. A model is therefore judged on
groups it has seen nothing of: `split` and `kfold` keep whole trajectories, poses or loads together,
and `assert_disjoint` refuses data that share anything. The by-sample split of the papers exists
only under its own name.

A fit that stops early also needs rows to stop by: `training_and_validation` holds out whole
trajectories of the training data. A study that reproduces a publication marks its rows one by one
in the column `PART` instead, so that windows and friction states are still computed along whole
motions; estimators then leave the rows marked `TEST` out.
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
"""Source and number of a trajectory or pose; a load has no source."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Data to fit on and data to judge on; they share no group.

    Attributes:
        train: Whole groups to fit on.
        test: Whole groups held out.
        by: What a group is.
        held_out: The groups in `test`.
    """

    train: Dataset
    test: Dataset
    by: SplitBy
    held_out: tuple[Group, ...]


def group_of(condition: Conditions, by: SplitBy) -> Group | None:
    """Return the group of a series; None when it belongs to none (a warm-up, say).

    Poses and trajectories are numbered within their source; a load is the same load everywhere.
    """
    if by == "load":
        return ("", condition.load)
    number: int = getattr(condition, by)
    return (condition.source, number) if number >= 0 else None


def groups(dataset: Dataset, by: SplitBy) -> tuple[Group, ...]:
    """Return the distinct groups, in order of appearance."""
    every = (group_of(condition, by) for condition in dataset.conditions)
    return tuple(dict.fromkeys(group for group in every if group is not None))


def split(
    dataset: Dataset,
    by: SplitBy,
    test: int | float | Sequence[int] = 0.2,
    seed: int = 0,
) -> Split:
    """Return the dataset in two, with whole groups held out.

    Args:
        dataset: What to split; series outside every group are left out of both parts.
        by: What must stay together. A pose keeps both its approaches and all its loads together.
        test: How many groups (int), which share of them (float below 1), or which numbers. With 0
            nothing is held out; any other share holds out at least one group.
        seed: For the draw; not used with numbers.

    Raises:
        DataError: There are not enough groups, or a number does not occur.
    """
    every = groups(dataset, by)
    if isinstance(test, int | float):
        held_out = _draw(every, by, test, seed)
    else:
        held_out = _numbered(every, by, test)
    if held_out and len(held_out) == len(every):
        raise DataError(
            f"nothing would be left to fit on: all {by} groups are held out",
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
    """Yield `folds` splits whose test parts are disjoint and together hold every group once.

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
"""Share of distinct samples that two independent recordings may have in common by chance."""


def assert_disjoint(train: Dataset, test: Dataset) -> None:
    """Raise if a test set shares a pose, a trajectory or samples with the training set.

    Loads may be shared. Samples are compared by value (position and effort, not time), so the same
    recording imported twice under different names, or with its clock shifted, is noticed too; up to
    1 % of the distinct samples may coincide, as noise-free simulations do where they start.

    The same *program* recorded twice passes, since the samples differ: see `hil.data.revisited`.

    Raises:
        DataError: Something is shared; the message names it.
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
            hint="the same recording was given twice, or a mock of the same seed repeated itself: "
            "record the second with another excitation.seed",
        )


def _sources_with(rows: IntArray, data: Dataset) -> str:
    """Name the sources of some fingerprints; empty if the data do not say them."""
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
    """Return a random split by *sample*, as in both papers: for reproducing their numbers only.

    Samples of the same pose or instant land on both sides, so errors measured this way say
    nothing about new poses or motions (docs/explanation/honest-protocols.md). Series end up with
    holes, which rules out filtering afterwards: prepare first.
    """
    kinds = np.random.default_rng(seed).choice(3, size=len(dataset), p=np.asarray(shares))
    first, second, third = (rows_of(dataset, kinds == part) for part in range(3))
    return first, second, third


# Rows to train on, to stop by and to judge


PART = "part"
"""Column (N,) with one of the three numbers below."""

TRAINING, VALIDATION, TEST = 0.0, 1.0, 2.0

SAMPLE_SPLIT_PROTOCOL = "paper: rows of the same motions to learn from and to judge"
"""Protocol of a model whose data have a by-sample split (`has_sample_split`)."""


def with_part(dataset: Dataset, part: FloatArray) -> Dataset:
    """Return the dataset with the column `PART` (N,)."""
    return dataset.with_columns(**{PART: np.asarray(part, dtype=np.float64)})


def has_sample_split(dataset: Dataset) -> bool:
    """Return whether the column `PART` puts rows of one motion on more than one side."""
    if PART not in dataset.columns:
        return False
    motions = (rows for condition, rows in dataset.slices() if condition.kind not in AT_REST)
    return any(len(np.unique(dataset[PART][rows])) > 1 for rows in motions)


def rows_to_fit(dataset: Dataset) -> BoolArray:
    """Return (N,) rows to fit on for estimators that do not stop early: all but those to judge."""
    if PART in dataset.columns:
        return np.asarray(dataset[PART] != TEST)
    return np.ones(len(dataset), dtype=bool)


def training_and_validation(
    dataset: Dataset, share: float = 2 / 9, seed: int = 0
) -> tuple[BoolArray, BoolArray]:
    """Return (N,) rows to train on and (N,) rows to stop by; a row may belong to neither.

    Args:
        dataset: With the column `PART`, which then decides alone, or without.
        share: Of the trajectories that is held out, at least one. Of a single trajectory it is
            the end.
        seed: Of the draw of trajectories.

    Raises:
        DataError: One of the two would be empty.
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
            "no rows are left to learn from"
            if not np.any(train)
            else "no rows are left to stop by",
            hint="give at least two trajectories, or one that is longer",
        )
    return train, validate


_END_SHARE = 0.2
"""Share of a single trajectory, at its end, that takes the place of held-out trajectories."""

_GAP_SHARE = 0.02
"""Share before it that belongs to neither side: neighbours in time are nearly the same."""


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
