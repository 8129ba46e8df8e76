"""What samples tell about a robot's base parameters: condition numbers and standard errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from hil.core import FloatArray
from hil.dynamics import base_parameters

if TYPE_CHECKING:
    from hil.dynamics import RobotModel

SIGN_WIDTH_RAD_S = 0.01
"""Of tanh(qd / width), which stands for the sign in Coulomb columns."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """The triangle R of a regressor W = Q·R, which tells as much about parameters as W itself.

    Attributes:
        triangle: (b, b) upper triangle.
        names: (b,) of the parameters.
    """

    triangle: FloatArray
    names: tuple[str, ...]

    def with_more(self, other: Information) -> Information:
        """What both tell together."""
        stacked = np.vstack([self.triangle, other.triangle])
        return Information(_triangle(stacked), self.names)

    @property
    def condition_raw(self) -> float:
        """Condition number of the regressor as it stands, in mixed units."""
        return float(np.linalg.cond(self.triangle))

    @property
    def condition_scaled(self) -> float:
        """Condition number with every column scaled to length 1."""
        values = self.singular_values
        return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")

    @property
    def singular_values(self) -> FloatArray:
        """(b,) of the regressor with every column scaled to length 1, largest first."""
        length = np.linalg.norm(self.triangle, axis=0)
        scaled = self.triangle / np.where(length > 0, length, 1.0)
        return np.asarray(np.linalg.svd(scaled, compute_uv=False))

    @property
    def standard_errors(self) -> FloatArray:
        """(b,) of parameters fitted by least squares, per unit of noise in every effort.

        All infinite where the samples do not determine every parameter.
        """
        if np.any(np.diag(self.triangle) == 0):
            return np.full(len(self.names), np.inf)
        inverse = scipy.linalg.solve_triangular(self.triangle, np.eye(len(self.names)))
        return np.asarray(np.linalg.norm(inverse, axis=1))


class Regressor:
    """The base regressor of a robot, with columns of friction on request.

    Args:
        robot: The arm.
        rotor: Whether rotor inertias count as parameters.
        friction: Whether Coulomb, viscous and offset friction of each joint do.
    """

    def __init__(self, robot: RobotModel, *, rotor: bool = True, friction: bool = False) -> None:
        self._robot = robot
        self._rotor, self._friction = rotor, friction
        self._base = base_parameters(robot, rotor=rotor)
        joints = range(1, robot.n + 1)
        more = [f"{name}_{joint}" for name in ("Fc", "Fv", "offset") for joint in joints]
        self.names = (*self._base.names, *(more if friction else ()))

    def columns(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N·n, b) regressor at q, qd, qdd, each (N, n)."""
        W = self._base.reduce(self._robot.regressor(q, qd, qdd, rotor=self._rotor))
        if not self._friction:
            return W
        signals = (np.tanh(qd / SIGN_WIDTH_RAD_S), qd, np.ones_like(qd))
        return np.hstack([W, *(_of_each_joint(signal) for signal in signals)])

    def information(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Information:
        """What samples tell; q, qd, qdd each (N, n)."""
        return Information(_triangle(self.columns(q, qd, qdd)), self.names)


def _of_each_joint(signal: FloatArray) -> FloatArray:
    """(N·n, n) columns of one parameter per joint, for a signal (N, n)."""
    samples, n = signal.shape
    out = np.zeros((samples, n, n))
    out[:, np.arange(n), np.arange(n)] = signal
    return out.reshape(-1, n)


def _triangle(W: FloatArray) -> FloatArray:
    """(b, b) of a regressor (M, b), with rows of zeros where it is shorter than wide."""
    rows: FloatArray = scipy.linalg.qr(W, mode="r")[0][: W.shape[1]]
    return np.pad(rows, ((0, W.shape[1] - len(rows)), (0, 0)))
