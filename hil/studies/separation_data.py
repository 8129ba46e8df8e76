"""What a separation study takes from a run: its dwells, the noise in them, and who is paired.

`recording_of` leaves out what cannot be used and says so. `by_sample` splits the samples as the
paper does, `by_pose` gives the same shares of whole poses.
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
"""Two to fit on and two to judge on; what each model needs it states itself."""

DWELL = "dwell_number"

ROW = "row_number"
"""Columns by which rows are found again after a split."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A run as a separation study sees it.

    Attributes:
        whole: All of it, moves included.
        dwells: Settled dwells of finite samples, with their row and dwell numbers as columns.
        robot: Model of the arm.
        notes: What was left out, and what else is not as it should be.
    """

    whole: Dataset
    dwells: Dataset
    robot: RobotModel
    notes: tuple[str, ...]


def recording_of(whole: Dataset, robot: RobotModel) -> Recording:
    """The dwells of a run that can be used.

    Raises:
        FitError: There are none, too few poses, or the model is of another robot.
    """
    require_robot(whole, robot)
    every = dwells_of(whole)
    dwells, notes = _finite(every)
    poses = len({pose_key(c) for c in dwells.conditions})
    NEEDS.require(poses=poses)
    unsettled = sum(c.kind == "dwell" and not c.settled for c in whole.conditions)
    if unsettled:
        notes.append(f"{unsettled} dwells that never came to rest are left out")
    notes += [*_short(dwells), *_still(dwells)]
    return Recording(whole, numbered(dwells), robot, tuple(notes))


def _finite(dwells: Dataset) -> tuple[Dataset, list[str]]:
    """The dwells all of whose samples are numbers."""
    sound = np.isfinite(dwells["q"]).all(axis=1) & np.isfinite(dwells["effort"]).all(axis=1)
    bad = set(dwells.series_index()[~sound].tolist())
    if not bad:
        return dwells, []
    kept = {id(c) for number, c in enumerate(dwells.conditions) if number not in bad}
    note = f"{len(bad)} dwells hold NaN or infinite positions or efforts and are left out"
    return dwells.select(lambda condition: id(condition) in kept), [note]


def _short(dwells: Dataset) -> list[str]:
    counts = np.diff(dwells.offsets)
    short = counts[counts < SAMPLES_PER_DWELL]
    if not len(short):
        return []
    return [
        f"{len(short)} of {len(counts)} dwells have fewer than {SAMPLES_PER_DWELL} samples (the "
        f"shortest {short.min()}); each is used as it is"
    ]


def _still(dwells: Dataset) -> list[str]:
    span = np.ptp(dwells["q"], axis=0)
    still = [name for name, s in zip(dwells.joint_names, span, strict=True) if s < STILL_RAD]
    return [f"{', '.join(still)} never moved: nothing is learned about it"] if still else []


def numbered(dwells: Dataset) -> Dataset:
    """With the numbers of rows and dwells as columns."""
    number = dwells.series_index().astype(np.float64)
    return dwells.with_columns(**{ROW: np.arange(len(dwells), dtype=np.float64), DWELL: number})


def rows_in(part: Dataset) -> IntArray:
    """(N,) which rows of the numbered dataset a part of it holds."""
    return np.asarray(part[ROW].astype(np.int64))


def dwells_in(part: Dataset) -> IntArray:
    """(N,) the dwell of the numbered dataset that each row belongs to."""
    return np.asarray(part[DWELL].astype(np.int64))


def pose_key(condition: Conditions) -> Hashable:
    """The same for dwells of one pose with one load; dwells without a pose stand alone."""
    return group_of(condition, "pose") or condition.id, condition.load


def one_per_pose(dwells: Dataset, seed: int) -> Dataset:
    """One dwell of every pose, drawn: the paper's program visits each pose once."""
    of_pose: dict[Hashable, list[int]] = {}
    for number, condition in enumerate(dwells.conditions):
        of_pose.setdefault(pose_key(condition), []).append(number)
    draw = np.random.default_rng([seed, 1])
    chosen = {numbers[int(draw.integers(len(numbers)))] for numbers in of_pose.values()}
    ids = {id(dwells.conditions[number]) for number in chosen}
    return numbered(dwells.select(lambda condition: id(condition) in ids))


def pairs(conditions: tuple[Conditions, ...]) -> list[tuple[list[int], list[int]]]:
    """Per pose approached from both sides: its dwells from below, and those from above."""
    sides: dict[Hashable, tuple[list[int], list[int]]] = {}
    for number, condition in enumerate(conditions):
        if condition.approach:
            both = sides.setdefault(pose_key(condition), ([], []))
            both[0 if condition.approach > 0 else 1].append(number)
    return [both for both in sides.values() if both[0] and both[1]]


def dwell_means(dwells: Dataset, values: FloatArray) -> FloatArray:
    """(S, n) mean of values (N, n) over each dwell."""
    return series_means(dwells, values)


def sample_noise(dwells: Dataset) -> FloatArray:
    """(n,) scatter of a single sample about the mean of its dwell, in effort units."""
    freedom = np.maximum(np.diff(dwells.offsets) - 1.0, 0.0)
    total = max(float(np.sum(freedom)), 1.0)
    return np.asarray(np.sqrt(freedom @ scatter(dwells) / total))


def mean_noise(dwells: Dataset) -> FloatArray:
    """(n,) what that scatter leaves in the mean of a dwell."""
    count = np.diff(dwells.offsets)
    return np.asarray(sample_noise(dwells) * np.sqrt(np.mean(1.0 / np.maximum(count, 1))))


def bare(dwells: Dataset) -> Dataset:
    """Without what no estimator asks for: it travels to every process."""
    kept = ("t", "q", "qd", "effort", "temperature", ROW, DWELL)
    columns = {name: dwells[name] for name in kept if name in dwells.columns}
    return replace(dwells, columns=columns)


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
