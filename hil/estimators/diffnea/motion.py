"""What friction columns see of a motion: speed, its sign, the way travelled, the gears' torque."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset
from hil.estimators.friction_memory import Pieces, path_steps


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """One joint's motion, all series behind each other; arrays are (N,).

    Attributes:
        qd: Velocity [rad/s].
        sign: Its smoothed sign.
        transmitted: Torque through the gear: rigid body and load, without friction [N·m].
        pieces: The way between reversals; None where states are given, or nobody needs any.
        given: States by multiple of the shortest length, where they are carried, as in a stream.
    """

    qd: FloatArray
    sign: FloatArray
    transmitted: FloatArray
    pieces: Pieces | None = None
    given: Mapping[float, FloatArray] | None = None

    def every(self, k: int) -> JointMotion:
        """Every k-th sample, with the memory of all."""
        columns = (self.qd, self.sign, self.transmitted)
        qd, sign, transmitted = (np.ascontiguousarray(column[::k]) for column in columns)
        return JointMotion(qd, sign, transmitted, self.pieces and self.pieces.every(k))

    def state(self, length: float, multiple: float) -> tuple[FloatArray, FloatArray]:
        """Dahl's state with `multiple` times the length [rad], and its slope by the length."""
        if self.given is not None:
            return self.given[multiple], np.zeros_like(self.qd)
        assert self.pieces is not None
        state, by_log = self.pieces.state(multiple * length)
        return state, by_log / length


@dataclass(frozen=True, slots=True, eq=False)
class ArmMotion:
    """The motion of all joints; arrays are (N, n), as in `JointMotion`.

    Attributes:
        steps: Way since the sample before [rad].
        series: Rows of every series.
    """

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
        columns = (self.qd, self.sign, self.transmitted, self.steps)
        qd, sign, transmitted, steps = (np.ascontiguousarray(column[:, j]) for column in columns)
        if self.given is not None:
            given = {k: state[:, j] for k, state in self.given.items()}
            return JointMotion(qd, sign, transmitted, None, given)
        return JointMotion(qd, sign, transmitted, Pieces.of(steps, self.series))


def sign_of(qd: FloatArray, width: float) -> FloatArray:
    """tanh(q̇/width), or the hard sign where the width is 0."""
    return np.tanh(qd / width) if width > 0 else np.sign(qd)
