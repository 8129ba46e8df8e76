"""What friction takes for the sign of the motion: the smooth sign, or a state with memory.

A joint that turns round does not meet full friction at once (Dahl, 1968). Its state, carried along
the path at the recorded rate, replaces sign(q̇) in every friction law of a network; the one length
it has per joint is found beforehand, by a line of linear fits.
"""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset
from hil.dynamics import RobotModel, base_parameters
from hil.estimators import CHUNK, dahl_states, path_steps

DIRECTION = "direction"
"""Column (N, n) of a dataset: the smooth sign of the motion, or Dahl's state."""

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
    motion = [dataset[name][learn] for name in ("q_f", "qd_f", "qdd_f")]
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
