"""Training data of a Lagrangian network: torque of the arm and a friction direction per row.

`Preparation.task` downsamples a filtered dataset, removes the test rows, subtracts the torque of
declared loads, and divides the remaining rows into training and validation rows.

The friction direction replaces the sign of the velocity in the friction laws. The friction
direction is either the smooth sign of the velocity or a state with memory (Dahl's state). After a
joint reverses its direction, friction does not reach its full value at once (Dahl, 1968). Dahl's
state is integrated along the path at the recorded rate and replaces sign(q̇) in every friction law
of a network. Before the training, the characteristic length of Dahl's state is fitted per joint:
linear fits for several lengths are compared.
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
"""Name of the dataset column (N, n) with the friction direction: smooth sign or Dahl's state."""

ROW = "row"
"""Name of the dataset column (N,) with the row numbers from before rows were removed."""

LEAST_STD_NM = 1e-3
"""Minimum standard deviation [N·m] that is assumed for a joint whose torque hardly changes."""


@dataclass(frozen=True, slots=True)
class Preparation:
    """Settings with which a dataset is converted to a `Task`.

    Attributes:
        filters: Filter settings, which also determine which rows are retained.
        memory: Whether the friction direction is Dahl's state; otherwise the smooth sign is used.
        sign_width: Width of the smooth sign [rad/s].
        validation_share: Share of the trajectories used for early stopping.
        seed: Seed for drawing the validation trajectories.
    """

    filters: FilterSettings
    memory: bool
    sign_width: float
    validation_share: float
    seed: int

    def task(self, data: Dataset, scale: FloatArray, robot: RobotModel) -> Task:
        """Return the learning task of a prepared dataset that contains all its rows.

        Raises:
            DataError: No training rows or no validation rows are left.
        """
        kept = self._kept(data)
        learn, validate = training_and_validation(kept, self.validation_share, self.seed)
        torque = target(kept, scale, robot)
        length = None
        if self.memory:
            numbers = kept[ROW][learn].astype(np.int64)
            length = fitted_lengths(data, torque[learn], numbers, robot)
        # Dahl's state depends on the whole path, so the directions are computed for all rows.
        all_of_them = directions(data, self.sign_width, length)
        kept = kept.with_columns(**{DIRECTION: all_of_them[kept[ROW].astype(np.int64)]})
        std = np.maximum(np.std(torque[learn], axis=0), LEAST_STD_NM)
        return Task(kept, torque, learn, validate, std, length)

    def _kept(self, data: Dataset) -> Dataset:
        """Return the downsampled dataset without the test rows."""
        numbered = data.with_columns(**{ROW: np.arange(len(data), dtype=np.float64)})
        thinned = downsample(numbered, self.filters)
        return rows_of(thinned, rows_to_fit(thinned))


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Data from which a Lagrangian network learns.

    Attributes:
        data: Prepared and downsampled dataset with the column `DIRECTION`, without test rows.
        torque: (N, n) torque of the rows [N·m], without the torque of declared loads.
        learn, validate: (N,) masks of the training rows and of the validation rows.
        torque_std: (n,) standard deviation of the torque of the training rows [N·m].
        length: (n,) characteristic length of Dahl's state [rad]; None if the direction is the
            smooth sign.
    """

    data: Dataset
    torque: FloatArray
    learn: BoolArray
    validate: BoolArray
    torque_std: FloatArray
    length: FloatArray | None


def target(data: Dataset, scale: FloatArray, robot: RobotModel) -> FloatArray:
    """Return the torque (N, n) of the arm alone [N·m]: measured minus that of declared loads."""
    load = payload_torque(robot, data, *(data[name] for name in MOTION))
    return np.asarray(data["effort_f"] * scale - load)


def directions(data: Dataset, width: float, length: FloatArray | None) -> FloatArray:
    """Return the friction direction (N, n) of every row of a prepared dataset.

    Args:
        data: Prepared dataset with all rows.
        width: Width of the smooth sign [rad/s], used if `length` is None.
        length: (n,) characteristic length of Dahl's state [rad]; None selects the smooth sign.
    """
    if length is None:
        return smooth_sign(data["qd_f"], width)
    return carried_directions(data, length)


LENGTHS_RAD = np.geomspace(3e-5, 3e-2, 13)
"""Candidate lengths of Dahl's state [rad], from microslip to the wind-up of gears."""


def smooth_sign(qd: FloatArray, width: float) -> FloatArray:
    """Return tanh(qd/width), or the sign of qd if the width is 0."""
    return np.asarray(np.sign(qd) if width == 0.0 else np.tanh(qd / width))


def carried_directions(dataset: Dataset, length: FloatArray) -> FloatArray:
    """Return Dahl's state (N, n) of every row; the state is 0 at the start of every series.

    Args:
        dataset: Prepared dataset with all rows, because the state is integrated over all samples of
            a path.
        length: (n,) characteristic length of the state [rad].
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
    """Return the length (n,) [rad] per joint with which a linear model explains the torque best.

    For each candidate length, a linear model with the columns rigid body, state, velocity and
    offset is fitted. The linear fit only selects the length; the network does not use the
    coefficients of the fit.

    Args:
        dataset: Prepared dataset with all rows.
        torque: (M, n) torque to be explained by the linear model [N·m].
        learn: (M,) numbers of the rows in which the torque was measured.
        robot: Robot model that provides the rigid-body columns.
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
    """Return the base regressor (M, n, b) of the rows."""
    base = base_parameters(robot, rotor=True)
    motion = [dataset[name][learn] for name in MOTION]
    found = [
        base.regressor(robot, *(x[first : first + CHUNK] for x in motion))
        for first in range(0, len(learn), CHUNK)
    ]
    return np.concatenate(found).reshape(len(learn), dataset.n_joints, -1)


class _Explained:
    """Torque of one joint minus the part that all columns except the state explain."""

    def __init__(self, columns: FloatArray, torque: FloatArray) -> None:
        length = np.linalg.norm(columns, axis=0)
        self._basis = np.linalg.qr(columns[:, length > 0] / length[length > 0])[0]
        self._torque = self._without(torque)

    def left_with(self, state: FloatArray) -> float:
        """Return the residual sum of squares if the state (M,) is an additional column."""
        own = self._without(state)
        square = float(own @ own)
        explained = float(own @ self._torque) ** 2 / square if square > 0 else 0.0
        return float(self._torque @ self._torque) - explained

    def _without(self, values: FloatArray) -> FloatArray:
        return np.asarray(values - self._basis @ (self._basis.T @ values))
