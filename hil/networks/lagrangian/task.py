"""What a network is to learn: the torque of some rows, the direction of friction, and what from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.data import Dataset, FilterSettings, downsample, learn_and_validate, rows_of, rows_to_fit
from hil.dynamics import RobotModel
from hil.estimators import payload_torque
from hil.networks.lagrangian.direction import (
    DIRECTION,
    carried_directions,
    fitted_lengths,
    smooth_sign,
)

MOTION = ("q_f", "qd_f", "qdd_f")

ROW = "row"
"""Column (N,) with the number of every row before some are left out."""

LEAST_STD_NM = 1e-3
"""A joint whose torque hardly changes is learned as if it changed by so much."""


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
        learn, validate = learn_and_validate(kept, self.validation_share, self.seed)
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


def target(data: Dataset, scale: FloatArray, robot: RobotModel) -> FloatArray:
    """(N, n) torque of the arm alone: measured, less that of declared loads [N·m]."""
    load = payload_torque(robot, data, *(data[name] for name in MOTION))
    return np.asarray(data["effort_f"] * scale - load)


def directions(data: Dataset, width: float, length: FloatArray | None) -> FloatArray:
    """(N, n) what friction takes for the sign of the motion, of every row of a prepared dataset."""
    if length is None:
        return smooth_sign(data["qd_f"], width)
    return carried_directions(data, length)
