"""An arm with a friction law: its observations, and its torques once values are known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset
from hil.dynamics import BaseParameters, RobotModel
from hil.estimators.base import chunks, payload_torque
from hil.estimators.diffnea.forms import Form, spread
from hil.estimators.diffnea.motion import ArmMotion, sign_of
from hil.estimators.diffnea.rows import BendingRows

MOTION = ("q_f", "qd_f", "qdd_f")

MOST_ROWS = 10_000
"""Rows that shapes are fitted to; of longer recordings, evenly chosen ones."""


@dataclass(frozen=True, slots=True, eq=False)
class DiffneaArm:
    """What turns motion into columns and values into torques.

    Attributes:
        robot: Nominal model.
        base: Its base parameters.
        form: Friction law of every joint.
        width: Of the smoothed sign [rad/s].
    """

    robot: RobotModel
    base: BaseParameters
    form: Form
    width: float

    def friction_values(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, k) coefficients and (n, S) shapes."""
        n, k = self.robot.n, len(self.form.terms)
        own = values[self.base.rank :]
        return own[: n * k].reshape(n, k), own[n * k :].reshape(n, -1)

    def rigid_rows(self, data: Dataset) -> Iterator[tuple[slice, FloatArray]]:
        """Rows and base regressor (N·n, b), in order."""
        for rows in chunks(data):
            yield rows, self.base.regressor(self.robot, *(data[name][rows] for name in MOTION))

    def load(self, data: Dataset) -> FloatArray:
        """(N, n) torque of declared loads [N·m]."""
        return payload_torque(self.robot, data, *(data[name] for name in MOTION))

    def motion(self, data: Dataset, gear: FloatArray) -> ArmMotion:
        """What friction sees, with the gears' torque by base parameters `gear` (b,)."""
        transmitted = np.zeros_like(data["q_f"])
        if self.form.multiples:
            transmitted = self.load(data)
            for rows, Y in self.rigid_rows(data):
                transmitted[rows] += (Y @ gear).reshape(-1, self.robot.n)
        return ArmMotion.of(data, transmitted, self.width)

    def moment(
        self,
        qd: FloatArray,
        transmitted: FloatArray | None = None,
        states: Mapping[float, FloatArray] | None = None,
    ) -> ArmMotion:
        """What friction sees of samples (N, n) that stand alone, or whose states are carried."""
        still = np.zeros_like(qd)
        load = still if transmitted is None else transmitted
        return ArmMotion(qd, sign_of(qd, self.width), load, still, (), states or {})

    def observations(
        self, data: Dataset, target: FloatArray, values: FloatArray, gear: FloatArray
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Rows, [Y | C | ∂C/∂s·c] (N·n, b + nk + nS) and target torques (N, n), in order."""
        c, shapes = self.friction_values(values)
        C, slope = self.form.evaluate(self.motion(data, gear), shapes)
        bent = np.einsum("Njks,jk->Njs", slope, c)
        for rows, Y in self.rigid_rows(data):
            yield rows, np.hstack([Y, spread(C[rows]), spread(bent[rows])]), target[rows]

    def bending_rows(self, data: Dataset, target: FloatArray, gear: FloatArray) -> BendingRows:
        """Rows of bounded number to fit shapes to."""
        every = -(-len(data) // MOST_ROWS)
        shape = (-1, self.robot.n, self.base.rank)
        parts = [
            Y.reshape(shape)[-rows.start % every :: every] for rows, Y in self.rigid_rows(data)
        ]
        motion = self.motion(data, gear)
        return BendingRows(np.concatenate(parts), target[::every], motion, self.form, every)

    def friction(self, motion: ArmMotion, values: FloatArray) -> FloatArray:
        """(N, n) friction torque [N·m]."""
        c, shapes = self.friction_values(values)
        return np.asarray(np.einsum("Njk,jk->Nj", self.form.evaluate(motion, shapes)[0], c))

    def rigid(self, values: FloatArray, *motion: FloatArray) -> FloatArray:
        """(N, n) rigid-body torque of a motion q, q̇, q̈ [N·m]."""
        torque = self.base.regressor(self.robot, *motion) @ values[: self.base.rank]
        return np.asarray(torque).reshape(motion[0].shape)
