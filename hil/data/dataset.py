"""Aligned samples with units and conditions: the only input of an estimator.

A `Dataset` is flat: every column contains the rows of all series in sequence. `offsets` contains
the first row of each series, and `conditions[i]` contains the conditions of series i. A *series* is
a whole trajectory or one dwell; a split must never divide a series.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FloatArray, IntArray, card

UPRIGHT = (0.0, 0.0, -9.81)
"""Gravity in the base frame of an arm on a level table [m/s²]."""

MOTION = ("q_f", "qd_f", "qdd_f")
"""Names of the filtered motion columns, in the order of the arguments of a regressor."""

PREPARED = (*MOTION, "effort_f")
"""Names of the columns that filtering adds (`hil.data.prepare`)."""

OF_JOINTS = frozenset({"q", "qd", "qdd", "effort", *PREPARED})
"""Names of the columns that a model reads; each column has the shape (N, n)."""

SeriesKind = Literal["trajectory", "dwell", "move", "warmup", "reference"]

AT_REST: tuple[SeriesKind, ...] = ("dwell", "reference")
"""Kinds of series during which the arm is at rest.

Series of these kinds are too short to filter, and have zero velocity.
"""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which one series was recorded.

    Attributes:
        id: Identifier of the series for tables and messages, unique within the dataset.
        kind: Kind of the series, such as a trajectory or a dwell.
        source: Run directory or file that contains the recording.
        trajectory: Index of the trajectory; −1 if there is none.
        pose: Index of the pose; −1 if there is none.
        approach: Approach direction of the pose, +1 or −1; 0 if mixed or unknown.
        load: Index of the mounted payload in the list `loads` of the spec.
        payload: Declared payload.
        payload_identified: Payload identified from data; None if no payload was identified.
        attempt: Index of the recording attempt, from 0.
        settled: Whether the arm was at rest before a dwell reached its time-out.
    """

    id: str
    kind: SeriesKind
    source: str = ""
    trajectory: int = -1
    pose: int = -1
    approach: int = 0
    load: int = 0
    payload: Payload = field(default_factory=Payload)
    payload_identified: Payload | None = None
    attempt: int = 0
    settled: bool = True


@dataclass(frozen=True, eq=False)
class Dataset:
    """Aligned samples of one robot.

    Attributes:
        robot: Robot model name or URDF path that the recording declares.
        joint_names: Names of the n joints, in the order of every (N, n) column.
        effort_kind: Kind of the effort: `current` [A] or `torque` [N·m].
        columns: `t` (N,) and any of `q`, `qd`, `qdd`, `effort`, `temperature`, `effort_target`,
            `q_target`, `torque_target` [N·m], … each (N, n). The columns `t`, `q` and `effort` are
            always present.
        offsets: (S + 1,) index of the first row of each series; the last entry is N.
        conditions: Recording conditions of each of the S series.
        drive_gains: (n,) torque per current [N·m/A], or None if unknown.
        drive_gains_source: Text that states the source of the drive gains.
        gravity: Gravity vector in the base frame of the robot [m/s²], which defines the mounting of
            the arm.
        arrivals: (S, K, 2, n) arrival path of each joint into the rest position of each series, see
            `hil.data.arrival`; NaN for series that are not dwells, None if no arrival path is
            known.
    """

    robot: str
    joint_names: tuple[str, ...]
    effort_kind: Literal["current", "torque"]
    columns: Mapping[str, FloatArray]
    offsets: IntArray
    conditions: tuple[Conditions, ...]
    drive_gains: FloatArray | None = None
    drive_gains_source: str = ""
    gravity: tuple[float, float, float] = UPRIGHT
    arrivals: FloatArray | None = None

    def __post_init__(self) -> None:
        rows = {name: len(values) for name, values in self.columns.items()}
        missing = {"t", "q", "effort"} - rows.keys()
        if missing:
            raise DataError(f"dataset lacks the columns {sorted(missing)}")
        if len(set(rows.values())) != 1:
            raise DataError(f"dataset columns differ in length: {rows}")
        shapes = {name: np.shape(self.columns[name]) for name in ("t", *OF_JOINTS & rows.keys())}
        joints = dict.fromkeys(shapes, (rows["t"], self.n_joints)) | {"t": (rows["t"],)}
        for name, shape in shapes.items():
            if shape != joints[name]:
                raise DataError(
                    f"the column {name} of a dataset has the shape {shape}, not {joints[name]}",
                    hint="give one value per row and joint: (N, n), and t as (N,)",
                )
        if len(self.offsets) != len(self.conditions) + 1 or self.offsets[-1] != rows["t"]:
            raise DataError("dataset offsets do not match its conditions and rows")
        if self.arrivals is not None and len(self.arrivals) != len(self.conditions):
            raise DataError("dataset arrivals do not match its conditions")

    def __len__(self) -> int:
        return len(self.columns["t"])

    def __getitem__(self, column: str) -> FloatArray:
        try:
            return self.columns[column]
        except KeyError:
            raise DataError(
                f"the dataset has no column {column!r}",
                hint=f"it has {', '.join(sorted(self.columns))}",
            ) from None

    def __repr__(self) -> str:
        rows = f"{len(self)} × {self.n_joints} in {len(self.conditions)} series"
        return f"<Dataset of {self.robot}: {rows} [{self.effort_unit}]>"

    def _repr_html_(self) -> str:
        """Return an HTML summary of the dataset for a notebook."""
        facts = {
            "samples": f"{len(self):,}",
            "joints": self.n_joints,
            "effort": f"{self.effort_kind} [{self.effort_unit}]",
            "columns": ", ".join(sorted(self.columns)),
            "gains": self.drive_gains_source,
        }
        rows = (
            (one.id, one.kind, rows.stop - rows.start, f"{one.payload.mass:g} kg")
            for one, rows in self.slices()
        )
        return card("Dataset", self.robot, facts, table=(("series", "kind", "rows", "load"), rows))

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def effort_unit(self) -> str:
        """Unit of the effort: `A` or `N·m`."""
        return "A" if self.effort_kind == "current" else "N·m"

    def slices(self) -> Iterator[tuple[Conditions, slice]]:
        """Yield the conditions and the rows of each series of the dataset."""
        for i, condition in enumerate(self.conditions):
            yield condition, slice(int(self.offsets[i]), int(self.offsets[i + 1]))

    def series_index(self) -> IntArray:
        """Return (N,) the index of the series to which each row belongs."""
        return np.repeat(np.arange(len(self.conditions)), np.diff(self.offsets))

    def select(self, keep: Callable[[Conditions], bool]) -> Dataset:
        """Return a dataset of the series whose conditions satisfy `keep`, in order."""
        chosen = [i for i, condition in enumerate(self.conditions) if keep(condition)]
        return self.take(chosen)

    def of_kind(self, *kinds: SeriesKind) -> Dataset:
        """Return a dataset of the series that have one of these kinds."""
        return self.select(lambda condition: condition.kind in kinds)

    def with_columns(self, **columns: FloatArray) -> Dataset:
        """Return a copy of the dataset with columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})

    def take(self, chosen: Sequence[int] | IntArray) -> Dataset:
        """Return a dataset of the series with these indices, in the order of the indices."""
        spans = [np.arange(self.offsets[i], self.offsets[i + 1]) for i in chosen]
        rows = np.concatenate(spans) if spans else np.empty(0, dtype=np.int64)
        lengths = [len(span) for span in spans]
        return replace(
            self,
            columns={name: values[rows] for name, values in self.columns.items()},
            offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
            conditions=tuple(self.conditions[i] for i in chosen),
            arrivals=None if self.arrivals is None else self.arrivals[np.asarray(chosen, int)],
        )

    @staticmethod
    def concatenate(parts: Sequence[Dataset]) -> Dataset:
        """Return the concatenation of several datasets of one robot.

        Columns that are missing in any of the datasets are left out.

        Raises:
            DataError: The list of datasets is empty, or robot, joints, effort kind, gravity or
                drive gains of the datasets differ.
        """
        if not parts:
            raise DataError("no data: the list of datasets is empty")
        first = parts[0]
        for part in parts[1:]:
            _require_compatible(first, part)
        shared = set.intersection(*(set(part.columns) for part in parts))
        lengths = np.concatenate([np.diff(part.offsets) for part in parts])
        return replace(
            first,
            columns={n: np.concatenate([part.columns[n] for part in parts]) for n in shared},
            offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
            conditions=tuple(c for part in parts for c in part.conditions),
            arrivals=_joined_arrivals(parts),
        )


def _joined_arrivals(parts: Sequence[Dataset]) -> FloatArray | None:
    """Return the arrivals of all parts; NaN for parts without arrivals.

    If no part has arrivals, None is returned.
    """
    known = [part.arrivals for part in parts if part.arrivals is not None]
    if not known:
        return None
    unknown = np.full(known[0].shape[1:], np.nan)
    return np.concatenate(
        [
            np.broadcast_to(unknown, (len(part.conditions), *unknown.shape))
            if part.arrivals is None
            else part.arrivals
            for part in parts
        ]
    )


def _require_compatible(a: Dataset, b: Dataset) -> None:
    for what in ("robot", "joint_names", "effort_kind", "gravity"):
        if getattr(a, what) != getattr(b, what):
            raise DataError(
                f"cannot pool data: {what} is {getattr(a, what)!r} in one source "
                f"and {getattr(b, what)!r} in another",
                hint="fit the sources separately",
            )
    if (a.drive_gains is None) != (b.drive_gains is None) or (
        a.drive_gains is not None
        and b.drive_gains is not None
        and not np.allclose(a.drive_gains, b.drive_gains)
    ):
        raise DataError(
            "cannot pool data: the sources declare different drive gains",
            hint="fit them separately, or use the same drive gains for all: --gains FILE",
        )


def rows_of(dataset: Dataset, keep: BoolArray) -> Dataset:
    """Return the rows of a dataset for which `keep` (N,) is true; series may become shorter."""
    counts = np.add.reduceat(np.append(keep, False).astype(np.int64), dataset.offsets[:-1])
    counts[np.diff(dataset.offsets) == 0] = 0
    return replace(
        dataset,
        columns={name: values[keep] for name, values in dataset.columns.items()},
        offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
    )
