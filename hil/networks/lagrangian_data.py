"""What a Lagrangian network learns: the torque of some rows, and a direction of friction for each.

`Preparation.task` thins a filtered dataset, leaves out what is judged, subtracts the torque of
declared loads, and deals the rest into rows to learn from and rows to stop by.

The direction is what friction takes for the sign of the motion: the smooth sign of the velocity, or
a state with memory. A joint that turns round does not meet full friction at once (Dahl, 1968). The
state, carried along the path at the recorded rate, replaces sign(q̇) in every friction law of a
network; its one length per joint is found beforehand, by a line of linear fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import (
    MOTION,
    Dataset,
    FilterSettings,
    downsample,
    rows_of,
    rows_to_fit,
    training_and_validation,
)
from hil.dynamics import RobotModel, base_parameters
from hil.estimators import CHUNK, dahl_states, path_steps, payload_torque

DIRECTION = "direction"
"""Column (N, n) of a dataset: the smooth sign of the motion, or Dahl's state."""

ROW = "row"
"""Column (N,) with the number of every row before some are left out."""

LEAST_STD_NM = 1e-3
"""A joint whose torque hardly changes is learned as if it changed by so much."""


@dataclass(frozen=True, slots=True)
class Preparation:
    """How rows become a task.

    Attributes:
        filters: Say which rows are kept.
        memory: Whether the direction is Dahl's state.
        sign_width: Of the smooth sign [rad/s].
        validation_share: Of the trajectories, to stop by.
        seed: Of their draw.
    """

    filters: FilterSettings
    memory: bool
    sign_width: float
    validation_share: float
    seed: int

    def task(self, data: Dataset, scale: FloatArray, robot: RobotModel) -> Task:
        """The task that a prepared dataset with all its rows poses.

        Raises:
            DataError: Nothing is left to learn from or to stop by.
        """
        kept = self._kept(data)
        learn, validate = training_and_validation(kept, self.validation_share, self.seed)
        torque = target(kept, scale, robot)
        length = None
        if self.memory:
            numbers = kept[ROW][learn].astype(np.int64)
            length = fitted_lengths(data, torque[learn], numbers, robot)
        # Directions are carried along every row, kept or not.
        all_of_them = directions(data, self.sign_width, length)
        kept = kept.with_columns(**{DIRECTION: all_of_them[kept[ROW].astype(np.int64)]})
        std = np.maximum(np.std(torque[learn], axis=0), LEAST_STD_NM)
        return Task(kept, torque, learn, validate, std, length)

    def _kept(self, data: Dataset) -> Dataset:
        """Thinned, and without what is judged."""
        numbered = data.with_columns(**{ROW: np.arange(len(data), dtype=np.float64)})
        thinned = downsample(numbered, self.filters)
        return rows_of(thinned, rows_to_fit(thinned))


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What a network is to learn.

    Attributes:
        data: Prepared and thinned, with the column `DIRECTION`; nothing in it is judged.
        torque: (N, n) of its rows [N·m], without that of declared loads.
        learn, validate: (N,) rows to learn from and to stop by.
        torque_std: (n,) of the rows to learn from [N·m].
        length: (n,) of Dahl's state [rad]; None for the smooth sign.
    """

    data: Dataset
    torque: FloatArray
    learn: BoolArray
    validate: BoolArray
    torque_std: FloatArray
    length: FloatArray | None


def target(data: Dataset, scale: FloatArray, robot: RobotModel) -> FloatArray:
    """(N, n) torque of the arm alone: measured, less that of declared loads [N·m]."""
    load = payload_torque(robot, data, *(data[name] for name in MOTION))
    return np.asarray(data["effort_f"] * scale - load)


def directions(data: Dataset, width: float, length: FloatArray | None) -> FloatArray:
    """(N, n) what friction takes for the sign of the motion, of every row of a prepared dataset."""
    if length is None:
        return smooth_sign(data["qd_f"], width)
    return carried_directions(data, length)


LENGTHS_RAD = np.geomspace(3e-5, 3e-2, 13)
"""Lengths in which the state comes round that are tried: from microslip to the wind-up of gears."""


def smooth_sign(qd: FloatArray, width: float) -> FloatArray:
    """tanh(qd/width), or the hard sign for a width of 0."""
    return np.asarray(np.sign(qd) if width == 0.0 else np.tanh(qd / width))


def carried_directions(dataset: Dataset, length: FloatArray) -> FloatArray:
    """(N, n) Dahl's state of every row; every series begins with 0.

    Args:
        dataset: Prepared, with all rows: states follow the path between them.
        length: (n,) in which the state comes round [rad].
    """
    steps = path_steps(dataset)
    states = np.zeros_like(steps)
    for _, rows in dataset.slices():
        if rows.stop > rows.start:
            states[rows] = dahl_states(steps[rows], length)
    return states


def fitted_lengths(
    dataset: Dataset, torque: FloatArray, learn: IntArray, robot: RobotModel
) -> FloatArray:
    """(n,) length per joint with which a linear model explains the torque best [rad].

    Per length one linear fit of rigid body, state, velocity and offset. It only chooses the
    length: nothing of it is handed to the network.

    Args:
        dataset: Prepared, with all rows.
        torque: (M, n) to be explained [N·m].
        learn: (M,) numbers of the rows that it was measured in.
        robot: Gives the rigid body's columns.
    """
    n = dataset.n_joints
    rigid, qd = _rigid_columns(dataset, learn, robot), dataset["qd_f"][learn]
    ones = np.ones(len(learn))
    known = [
        _Explained(np.column_stack([rigid[:, j], qd[:, j], ones]), torque[:, j]) for j in range(n)
    ]
    left = np.empty((len(LENGTHS_RAD), n))
    for k, length in enumerate(LENGTHS_RAD):
        states = carried_directions(dataset, np.full(n, length))[learn]
        left[k] = [one.left_with(states[:, j]) for j, one in enumerate(known)]
    return np.asarray(LENGTHS_RAD[np.argmin(left, axis=0)])


def _rigid_columns(dataset: Dataset, learn: IntArray, robot: RobotModel) -> FloatArray:
    """(M, n, b) base regressor of the rows."""
    base = base_parameters(robot, rotor=True)
    motion = [dataset[name][learn] for name in MOTION]
    found = [
        base.regressor(robot, *(x[first : first + CHUNK] for x in motion))
        for first in range(0, len(learn), CHUNK)
    ]
    return np.concatenate(found).reshape(len(learn), dataset.n_joints, -1)


class _Explained:
    """One joint's torque, less what the columns beside the state explain of it."""

    def __init__(self, columns: FloatArray, torque: FloatArray) -> None:
        length = np.linalg.norm(columns, axis=0)
        self._basis = np.linalg.qr(columns[:, length > 0] / length[length > 0])[0]
        self._torque = self._without(torque)

    def left_with(self, state: FloatArray) -> float:
        """Sum of squares that is left when the state (M,) is a column too."""
        own = self._without(state)
        square = float(own @ own)
        explained = float(own @ self._torque) ** 2 / square if square > 0 else 0.0
        return float(self._torque @ self._torque) - explained

    def _without(self, values: FloatArray) -> FloatArray:
        return np.asarray(values - self._basis @ (self._basis.T @ values))
