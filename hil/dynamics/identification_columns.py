"""The regressor an excitation is designed for: base parameters, rotors and friction by choice."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hil.core import FloatArray
from hil.dynamics.base import BaseParameters, base_parameters
from hil.dynamics.regressor_gradient import MotionGradient, RegressorSweep

if TYPE_CHECKING:
    from hil.dynamics.robot_model import RobotModel


class Rows(NamedTuple):
    """A regressor at some samples.

    Attributes:
        transposed: (b, n·N) the regressor's transpose, rows joint by joint.
        pull_back: From the derivative of a scalar by `transposed` to that by the motion.
    """

    transposed: FloatArray
    pull_back: Callable[[FloatArray], MotionGradient]


class IdentificationColumns:
    """Columns of independent parameters of one robot, differentiable by the motion.

    Args:
        robot: The robot.
        rotor: Whether rotor inertias are among the parameters.
        friction: Whether Coulomb, viscous and offset torques of every joint are.
        sign_width: Of tanh(qd / width), which stands for the sign in Coulomb columns [rad/s].
        base: The base parameters, where it is to be others than `base_parameters` chooses: the
            condition number of unscaled columns depends on the choice.

    Attributes:
        names: (b,) of the parameters: base parameters, then `coulomb_1` … `offset_n`.
    """

    def __init__(
        self,
        robot: RobotModel,
        *,
        rotor: bool = False,
        friction: bool = False,
        sign_width: float = 0.01,
        base: BaseParameters | None = None,
    ) -> None:
        base = base or base_parameters(robot, rotor=rotor)
        self._robot, self._geometry = robot, robot.joint_geometry()
        # Where one motor moves several joints, the rows are the motors' (`CoupledModel`).
        self._T: FloatArray = getattr(robot, "joints_per_motor", np.eye(robot.n))
        self._width, self._friction = sign_width, friction
        bodies = 10 * robot.n
        self._inertial = base.independent[base.independent < bodies]
        self._rotors = base.independent[base.independent >= bodies] - bodies
        added = [f"{kind}_{j + 1}" for kind in _FRICTION for j in range(robot.n)]
        self.names = (*base.names, *(added if friction else ()))

    def __len__(self) -> int:
        return len(self.names)

    def rows(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Rows:
        """The regressor at `q`, `qd`, `qdd`, each (N, n)."""
        joints = q @ self._T.T, qd @ self._T.T, qdd @ self._T.T
        sweep = RegressorSweep.of(self._robot, *joints, self._geometry)
        parts = [np.matmul(self._T.T, sweep.columns[self._inertial])]
        parts.append(_diagonal(qdd)[self._rotors])
        if self._friction:
            sign = np.tanh(qd / self._width)
            parts += [_diagonal(x) for x in (sign, qd, np.ones_like(qd))]
        (N, n), counts = q.shape, np.cumsum([len(part) for part in parts[:-1]])

        def pull_back(by_rows: FloatArray) -> MotionGradient:
            by_parts = np.split(by_rows.reshape(-1, n, N), counts)
            by = self._pull_back_inertial(sweep, by_parts[0])
            for joint, by_column in zip(self._rotors, by_parts[1], strict=True):
                by.qdd[:, joint] += by_column[joint]
            if self._friction:
                coulomb, viscous = (part[range(n), range(n)].T for part in by_parts[2:4])
                by.qd[:] += coulomb * (1.0 - sign**2) / self._width + viscous
            return by

        return Rows(np.concatenate(parts).reshape(-1, n * N), pull_back)

    def _pull_back_inertial(self, sweep: RegressorSweep, by_part: FloatArray) -> MotionGradient:
        by_bodies = np.zeros_like(sweep.columns)
        by_bodies[self._inertial] = np.matmul(self._T, by_part)
        return MotionGradient(*(by @ self._T for by in sweep.pull_back(by_bodies)))


def _diagonal(x: FloatArray) -> FloatArray:
    """(n, n, N): column j acts on joint j only, by x (N, n)."""
    N, n = x.shape
    out = np.zeros((n, n, N))
    out[np.arange(n), np.arange(n)] = x.T
    return out


_FRICTION = ("coulomb", "viscous", "offset")
