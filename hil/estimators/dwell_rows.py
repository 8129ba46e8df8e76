"""Dwells as rows of a regression: their means, their scatter, and the pose each belongs to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import SAMPLES_PER_DWELL, Dataset, group_of, series_means


def one_row_each(dwells: Dataset) -> Dataset:
    """The same series with their samples averaged to one row."""
    columns = {"t": dwells["t"][dwells.offsets[:-1]]}
    columns |= {name: series_means(dwells, dwells[name]) for name in ("q", "effort")}
    return replace(dwells, columns=columns, offsets=np.arange(len(dwells.conditions) + 1))


def pose_numbers(dwells: Dataset) -> IntArray:
    """(S,) pose of each series, numbered from 0; a series without a pose is one of its own."""
    known: dict[object, int] = {}
    groups = (group_of(condition, "pose") for condition in dwells.conditions)
    numbers = [known.setdefault(g or index, len(known)) for index, g in enumerate(groups)]
    return np.array(numbers, dtype=np.int64)


def scatter(dwells: Dataset) -> FloatArray:
    """(S, n) variance of each series' effort about its mean; 0 with a single sample."""
    effort = dwells["effort"]
    about = effort - series_means(dwells, effort)[dwells.series_index()]
    degrees = np.maximum(np.diff(dwells.offsets) - 1, 1)
    sums = np.add.reduceat(about**2, dwells.offsets[:-1], axis=0)
    return np.asarray(sums / degrees[:, None])


def short_dwells(dwells: Dataset) -> Iterator[str]:
    """A note when dwells have fewer samples than the static paper asks for."""
    counts = np.diff(dwells.offsets)
    short = counts[counts < SAMPLES_PER_DWELL]
    if len(short):
        yield (
            f"{len(short)} of {len(counts)} dwells have fewer than {SAMPLES_PER_DWELL} samples "
            f"(the shortest {short.min()}); each is used as it is"
        )
