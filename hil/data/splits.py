"""Splits that keep whole trajectories, poses or loads together, and a guard against leaks.

Neighbouring samples of one motion are nearly the same sample. A model is therefore judged on
groups it has seen nothing of; the by-sample split of the papers exists only under its own name.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hil.core import DataError
from hil.data.dataset import Conditions, Dataset, rows_of
from hil.data.fingerprints import fingerprints

SplitBy = Literal["trajectory", "pose", "load"]
Group: TypeAlias = tuple[str, int]

SAME_SHARE = 0.01
"""Share of distinct samples that two independent recordings may have in common by chance."""


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
    """Which group a series belongs to; None when it belongs to none (a warm-up, say).

    Poses and trajectories are numbered within their source; a load is the same load everywhere.
    """
    if by == "load":
        return ("", condition.load)
    number: int = getattr(condition, by)
    return (condition.source, number) if number >= 0 else None


def groups(dataset: Dataset, by: SplitBy) -> tuple[Group, ...]:
    """The distinct groups, in order of appearance."""
    found = (group_of(condition, by) for condition in dataset.conditions)
    return tuple(dict.fromkeys(group for group in found if group is not None))


def split(
    dataset: Dataset,
    by: SplitBy,
    test: int | float | Sequence[int] = 0.2,
    seed: int = 0,
) -> Split:
    """Hold out whole groups.

    Args:
        dataset: What to split; series outside every group are left out of both parts.
        by: What must stay together. A pose keeps both its approaches and all its loads together.
        test: How many groups (int), which share of them (float below 1), or which numbers. With 0
            nothing is held out; any other share holds out at least one group.
        seed: For the draw; not used when numbers are given.

    Raises:
        DataError: There are not enough groups, or a number does not occur.
    """
    everything = groups(dataset, by)
    if isinstance(test, int | float):
        held_out = _draw(everything, by, test, seed)
    else:
        held_out = _named(everything, by, test)
    if held_out and len(held_out) == len(everything):
        raise DataError(
            f"nothing would be left to fit on: all {by} groups are held out",
            hint="hold out fewer, or record more",
        )
    return _split_at(dataset, by, held_out)


def kfold(dataset: Dataset, by: SplitBy, folds: int, seed: int = 0) -> Iterator[Split]:
    """`folds` splits whose test parts are disjoint and together hold every group once.

    Raises:
        DataError: There are fewer groups than folds.
    """
    everything = groups(dataset, by)
    if not 2 <= folds <= len(everything):
        raise DataError(
            f"{folds} folds are not possible with {len(everything)} {by} group(s)",
            hint="choose at least 2 folds and at most one per group",
        )
    order = np.random.default_rng(seed).permutation(len(everything))
    for part in np.array_split(order, folds):
        yield _split_at(dataset, by, tuple(everything[i] for i in np.sort(part)))


def assert_disjoint(train: Dataset, test: Dataset) -> None:
    """Refuse a test set that shares a series, a pose, a trajectory or a sample with the training.

    Loads may be shared. Samples are compared by value (position and effort, not time), so the same
    recording imported twice under different names, or with its clock shifted, is found too; up to
    1 % of the distinct samples may coincide, as noise-free simulations do where they start.

    The same *program* recorded twice passes, since the samples differ: see
    `hil.data.fingerprints.revisited`.

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
                hint="split by whole groups: hil.data.splits.split(dataset, by=…)",
            )
    rows = fingerprints(test)
    same = int(np.isin(rows, fingerprints(train)).sum())
    if same > SAME_SHARE * len(rows):
        raise DataError(
            f"{same} samples of the test data are also in the training data",
            hint="the same recording was given twice; leave it out of one of the two",
        )


def paper_sample_split(
    dataset: Dataset, shares: tuple[float, float, float] = (0.75, 0.20, 0.05), seed: int = 0
) -> tuple[Dataset, Dataset, Dataset]:
    """Random split by *sample*, as in both papers: for reproducing their numbers only.

    Samples of the same pose or instant land on both sides, so errors measured this way say
    nothing about new poses or motions (docs/explanation/honest-protocols.md). Series end up with
    holes, which rules out filtering afterwards: prepare first.
    """
    kinds = np.random.default_rng(seed).choice(3, size=len(dataset), p=np.asarray(shares))
    first, second, third = (rows_of(dataset, kinds == part) for part in range(3))
    return first, second, third


def _draw(everything: Sequence[Group], by: SplitBy, test: float, seed: int) -> tuple[Group, ...]:
    if test == 0:
        return ()
    count = int(test) if test >= 1 else max(1, round(test * len(everything)))
    if test < 0 or count >= len(everything):
        raise DataError(
            f"cannot hold out {test if test < 0 else count} of {len(everything)} {by} group(s)",
            hint=f"the data needs at least {max(1, count) + 1} different {by} groups",
        )
    chosen = np.random.default_rng(seed).choice(len(everything), count, replace=False)
    return tuple(everything[i] for i in np.sort(chosen))


def _named(everything: Sequence[Group], by: SplitBy, numbers: Sequence[int]) -> tuple[Group, ...]:
    held_out = tuple(group for group in everything if group[1] in set(numbers))
    unknown = sorted(set(numbers) - {number for _, number in held_out})
    if unknown:
        known = sorted({number for _, number in everything})
        raise DataError(f"no {by} {unknown[0]} in the data", hint=f"there are {known}")
    return held_out


def _split_at(dataset: Dataset, by: SplitBy, held_out: tuple[Group, ...]) -> Split:
    chosen = set(held_out)
    test = dataset.select(lambda condition: group_of(condition, by) in chosen)
    train = dataset.select(lambda condition: group_of(condition, by) not in chosen | {None})
    return Split(train, test, by, held_out)
