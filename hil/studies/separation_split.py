"""How the paper splits its samples, and the same shares of whole poses."""

from __future__ import annotations

from dataclasses import dataclass

from hil.core import IntArray
from hil.data import Dataset, paper_sample_split, split
from hil.studies.separation_data import rows_in

SHARES = (0.75, 0.20, 0.05)
"""To train, test and validate on."""


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """Rows to train, test and validate on.

    Attributes:
        training: The training rows as a dataset.
        train, test, validation: (·,) row numbers.
    """

    training: Dataset
    train: IntArray
    test: IntArray
    validation: IntArray


def by_sample(data: Dataset, seed: int) -> Partition:
    """75/20/5 % of the samples, as the paper: ten samples of a pose land on all sides."""
    training, test, validation = paper_sample_split(data, SHARES, seed)
    return Partition(training, rows_in(training), rows_in(test), rows_in(validation))


def by_pose(data: Dataset, seed: int) -> Partition:
    """The same shares of whole poses.

    Raises:
        DataError: There are too few poses.
    """
    outer = split(data, "pose", SHARES[1], seed)
    inner = split(outer.train, "pose", SHARES[2] / (1 - SHARES[1]), seed)
    parts = inner.train, outer.test, inner.test
    return Partition(inner.train, *(rows_in(part) for part in parts))
