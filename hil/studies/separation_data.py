"""Data of the separation study: usable dwells of a run, their noise, and pairs of dwells.

The function `recording_of` excludes unusable dwells and adds a note for each reason. The function
`by_sample` splits the samples at random, as in the static paper. The function `by_pose` splits
whole poses with the same shares as `by_sample`.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import (
    SAMPLES_PER_DWELL,
    Conditions,
    Dataset,
    dwells_of,
    group_of,
    paper_sample_split,
    series_means,
    split,
)
from hil.dynamics import RobotModel
from hil.estimators import STILL_RAD, Needs, require_robot, scatter

NEEDS = Needs({"poses": 4})
"""Required data: at least two poses for training and two poses for testing.

Each model states its further data requirements itself.
"""

DWELL = "dwell_number"

ROW = "row_number"
"""The columns `DWELL` and `ROW` identify dwells and rows after a split."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Usable dwells of a run for a separation study.

    Attributes:
        whole: All data of the run, including the moves between dwells.
        dwells: Settled dwells with finite samples; the row and dwell numbers are stored as columns.
        robot: Model of the arm.
        notes: Notes on excluded dwells and other limitations of the data.
    """

    whole: Dataset
    dwells: Dataset
    robot: RobotModel
    notes: tuple[str, ...]


def recording_of(whole: Dataset, robot: RobotModel) -> Recording:
    """Return the usable dwells of a run.

    Raises:
        FitError: There are no dwells or too few poses, or the data are from a different robot.
    """
    require_robot(whole, robot)
    every = dwells_of(whole)
    dwells, notes = _finite(every)
    poses = len({pose_key(c) for c in dwells.conditions})
    NEEDS.require(poses=poses)
    unsettled = sum(c.kind == "dwell" and not c.settled for c in whole.conditions)
    if unsettled:
        notes.append(f"{unsettled} dwells that did not settle are omitted")
    notes += [*_short(dwells), *_still(dwells)]
    return Recording(whole, numbered(dwells), robot, tuple(notes))


def _finite(dwells: Dataset) -> tuple[Dataset, list[str]]:
    """Return the dwells with finite samples only, and a note on the dwells that were excluded."""
    sound = np.isfinite(dwells["q"]).all(axis=1) & np.isfinite(dwells["effort"]).all(axis=1)
    bad = set(dwells.series_index()[~sound].tolist())
    if not bad:
        return dwells, []
    kept = {id(c) for number, c in enumerate(dwells.conditions) if number not in bad}
    note = f"{len(bad)} dwells contain NaN or infinite positions or efforts and are omitted"
    return dwells.select(lambda condition: id(condition) in kept), [note]


def _short(dwells: Dataset) -> list[str]:
    counts = np.diff(dwells.offsets)
    short = counts[counts < SAMPLES_PER_DWELL]
    if not len(short):
        return []
    return [
        f"{len(short)} of {len(counts)} dwells have fewer than {SAMPLES_PER_DWELL} samples (the "
        f"shortest {short.min()}); they are used nevertheless"
    ]


def _still(dwells: Dataset) -> list[str]:
    span = np.ptp(dwells["q"], axis=0)
    still = [name for name, s in zip(dwells.joint_names, span, strict=True) if s < STILL_RAD]
    return [f"{', '.join(still)} never moved and cannot be identified"] if still else []


def numbered(dwells: Dataset) -> Dataset:
    """Return the dwells with row and dwell numbers as columns."""
    number = dwells.series_index().astype(np.float64)
    return dwells.with_columns(**{ROW: np.arange(len(dwells), dtype=np.float64), DWELL: number})


def rows_in(part: Dataset) -> IntArray:
    """Return the (N,) row numbers, in the complete dataset, of the rows in a part."""
    return np.asarray(part[ROW].astype(np.int64))


def dwells_in(part: Dataset) -> IntArray:
    """Return the (N,) dwell numbers, in the complete dataset, of the rows in a part."""
    return np.asarray(part[DWELL].astype(np.int64))


def pose_key(condition: Conditions) -> Hashable:
    """Return a key of a dwell that is equal for dwells of the same pose with the same payload.

    A dwell without a pose gets a unique key.
    """
    return group_of(condition, "pose") or condition.id, condition.load


def one_per_pose(dwells: Dataset, seed: int) -> Dataset:
    """Return one randomly selected dwell for every pose.

    The measuring program of the static paper also visits each pose once.
    """
    of_pose: dict[Hashable, list[int]] = {}
    for number, condition in enumerate(dwells.conditions):
        of_pose.setdefault(pose_key(condition), []).append(number)
    draw = np.random.default_rng([seed, 1])
    chosen = {numbers[int(draw.integers(len(numbers)))] for numbers in of_pose.values()}
    ids = {id(dwells.conditions[number]) for number in chosen}
    return numbered(dwells.select(lambda condition: id(condition) in ids))


def pairs(conditions: tuple[Conditions, ...]) -> list[tuple[list[int], list[int]]]:
    """Return dwell numbers per pose: dwells approached from below, and dwells from above.

    Poses that were approached from only one direction are omitted.
    """
    sides: dict[Hashable, tuple[list[int], list[int]]] = {}
    for number, condition in enumerate(conditions):
        if condition.approach:
            both = sides.setdefault(pose_key(condition), ([], []))
            both[0 if condition.approach > 0 else 1].append(number)
    return [both for both in sides.values() if both[0] and both[1]]


def dwell_means(dwells: Dataset, values: FloatArray) -> FloatArray:
    """Return the (S, n) mean of values (N, n) over each dwell."""
    return series_means(dwells, values)


def sample_noise(dwells: Dataset) -> FloatArray:
    """Return the (n,) standard deviation of samples around their dwell mean, in effort units."""
    freedom = np.maximum(np.diff(dwells.offsets) - 1.0, 0.0)
    total = max(float(np.sum(freedom)), 1.0)
    return np.asarray(np.sqrt(freedom @ scatter(dwells) / total))


def mean_noise(dwells: Dataset) -> FloatArray:
    """Return the (n,) standard deviation of dwell means caused by the noise of the samples."""
    count = np.diff(dwells.offsets)
    return np.asarray(sample_noise(dwells) * np.sqrt(np.mean(1.0 / np.maximum(count, 1))))


def bare(dwells: Dataset) -> Dataset:
    """Return the dwells with only those columns that the estimators use.

    The omission of other columns reduces the amount of data sent to other processes.
    """
    kept = ("t", "q", "qd", "effort", "temperature", ROW, DWELL)
    columns = {name: dwells[name] for name in kept if name in dwells.columns}
    return replace(dwells, columns=columns)


SHARES = (0.75, 0.20, 0.05)
"""Shares of the poses or samples for training, testing and validation."""


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """Row numbers of the training, test and validation parts.

    Attributes:
        training: Training rows as a `Dataset`.
        train, test, validation: (·,) row numbers of each part.
    """

    training: Dataset
    train: IntArray
    test: IntArray
    validation: IntArray


def by_sample(data: Dataset, seed: int) -> Partition:
    """Split the samples at random into 75/20/5 %, as in the static paper.

    The ten samples of one pose therefore belong to different parts of the split.
    """
    training, test, validation = paper_sample_split(data, SHARES, seed)
    return Partition(training, rows_in(training), rows_in(test), rows_in(validation))


def by_pose(data: Dataset, seed: int) -> Partition:
    """Split whole poses at random into 75/20/5 %.

    Raises:
        DataError: There are too few poses for the split.
    """
    outer = split(data, "pose", SHARES[1], seed)
    inner = split(outer.train, "pose", SHARES[2] / (1 - SHARES[1]), seed)
    parts = inner.train, outer.test, inner.test
    return Partition(inner.train, *(rows_in(part) for part in parts))
