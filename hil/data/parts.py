"""Which rows are learned from, which choose when to stop, and which nobody may look at.

Networks need a part of the data to stop by. Without being told, they hold out whole trajectories;
a study that reproduces a publication says it row by row in the column `PART`, so that windows and
friction states are still computed along whole motions.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.data.dataset import Dataset
from hil.data.filtering.downsampling import AT_REST
from hil.data.splits import group_of, groups, split

PART = "part"
"""Column (N,) with one of the three numbers below."""

LEARN, VALIDATE, JUDGE = 0.0, 1.0, 2.0

LAST_SHARE = 0.2
"""Share of a single trajectory, at its end, that takes the place of held-out trajectories."""

BY_SAMPLE = "paper: rows of the same motions to learn from and to judge"
"""Protocol of a model for which a study tore motions row by row (`told_by_sample`)."""

GAP = 0.02
"""Share of it before that which neither side gets: neighbours in time are nearly the same."""


def learn_and_validate(
    dataset: Dataset, share: float = 2 / 9, seed: int = 0
) -> tuple[BoolArray, BoolArray]:
    """(N,) rows to learn from and (N,) rows to stop by; a row may belong to neither.

    Args:
        dataset: With the column `PART`, which then decides alone, or without.
        share: Of the trajectories that is held out, at least one. Of a single trajectory it is
            the end.
        seed: Of the draw of trajectories.

    Raises:
        DataError: One of the two would be empty.
    """
    if PART in dataset.columns:
        part = dataset[PART]
        learn, validate = part == LEARN, part == VALIDATE
    elif len(groups(dataset, "trajectory")) > 1:
        learn, validate = _whole_trajectories(dataset, share, seed)
    else:
        learn, validate = _end(dataset)
    if not (np.any(learn) and np.any(validate)):
        raise DataError(
            "no rows are left to learn from"
            if not np.any(learn)
            else "no rows are left to stop by",
            hint="give at least two trajectories, or one that is longer",
        )
    return learn, validate


def rows_to_fit(dataset: Dataset) -> BoolArray:
    """(N,) rows that estimators may learn from which stop by nothing: all that are not judged."""
    if PART in dataset.columns:
        return np.asarray(dataset[PART] != JUDGE)
    return np.ones(len(dataset), dtype=bool)


def told_by_sample(dataset: Dataset) -> bool:
    """Whether rows of one motion are on more than one side of the split that a study told."""
    if PART not in dataset.columns:
        return False
    motions = (rows for condition, rows in dataset.slices() if condition.kind not in AT_REST)
    return any(len(np.unique(dataset[PART][rows])) > 1 for rows in motions)


def with_part(dataset: Dataset, part: FloatArray) -> Dataset:
    """The dataset with the column `PART` (N,)."""
    return dataset.with_columns(**{PART: np.asarray(part, dtype=np.float64)})


def _whole_trajectories(dataset: Dataset, share: float, seed: int) -> tuple[BoolArray, BoolArray]:
    held = set(split(dataset, "trajectory", share, seed).held_out)
    validate = np.zeros(len(dataset), dtype=bool)
    for condition, rows in dataset.slices():
        validate[rows] = group_of(condition, "trajectory") in held
    return ~validate, validate


def _end(dataset: Dataset) -> tuple[BoolArray, BoolArray]:
    learn, validate = (np.zeros(len(dataset), dtype=bool) for _ in range(2))
    for condition, rows in dataset.slices():
        if condition.kind in AT_REST:
            continue
        count = rows.stop - rows.start
        first = rows.start + int((1.0 - LAST_SHARE) * count)
        learn[rows.start : first - int(GAP * count)] = True
        validate[first : rows.stop] = True
    return learn, validate
