"""What friction columns see of a motion: speed, its sign, the way travelled, the gears' torque."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.data.dataset import Dataset
from hil.identify.friction.memory import dahl_slopes, dahl_states, path_steps
from hil.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """One joint's motion, all series behind each other; arrays are (N,).

    Attributes:
        qd: Velocity [rad/s].
        sign: Its smoothed sign.
        transmitted: Torque through the gear: rigid body and load, without friction [N·m].
        steps: Way since the sample before [rad]; empty for friction without memory.
        series: Rows of every series.
        given: States by multiple of the shortest length, where they are carried, as in a stream.
    """

    qd: FloatArray
    sign: FloatArray
    transmitted: FloatArray
    steps: FloatArray
    series: tuple[slice, ...] = ()
    given: Mapping[float, FloatArray] | None = None

    def state(self, length: float, multiple: float) -> tuple[FloatArray, FloatArray]:
        """Dahl's state with `multiple` times the length [rad], and its slope by the length."""
        if self.given is not None:
            return self.given[multiple], np.zeros_like(self.qd)
        state, slope = np.empty_like(self.qd), np.empty_like(self.qd)
        whole = np.array([multiple * length])
        for rows in self.series:
            steps = self.steps[rows, None]
            found = dahl_states(steps, whole)
            state[rows] = found[:, 0]
            slope[rows] = dahl_slopes(steps, whole, found)[:, 0] / length
        return state, slope


@dataclass(frozen=True, slots=True, eq=False)
class ArmMotion:
    """The motion of all joints; arrays are (N, n), as in `JointMotion`."""

    qd: FloatArray
    sign: FloatArray
    transmitted: FloatArray
    steps: FloatArray
    series: tuple[slice, ...] = ()
    given: Mapping[float, FloatArray] | None = None

    @classmethod
    def of(cls, data: Dataset, transmitted: FloatArray, width: float) -> ArmMotion:
        """That of prepared data; `width` [rad/s] smooths the sign."""
        qd = data["qd_f"]
        series = tuple(rows for _, rows in data.slices() if rows.stop > rows.start)
        return cls(qd, sign_of(qd, width), transmitted, path_steps(data), series)

    def joint(self, j: int) -> JointMotion:
        """Joint j alone."""
        given = self.given
        columns = (self.qd, self.sign, self.transmitted, self.steps)
        qd, sign, transmitted, steps = (np.ascontiguousarray(column[:, j]) for column in columns)
        return JointMotion(
            qd,
            sign,
            transmitted,
            steps,
            self.series,
            None if given is None else {k: state[:, j] for k, state in given.items()},
        )


def sign_of(qd: FloatArray, width: float) -> FloatArray:
    """tanh(q̇/width), or the hard sign where the width is 0."""
    return np.tanh(qd / width) if width > 0 else np.sign(qd)
