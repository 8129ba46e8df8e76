"""SciPy's SLSQP on the same problem, put plainly: all coefficients, all limits on all samples."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from hil.core.typing import FloatArray, IntArray
from hil.dynamics import RobotModel
from hil.dynamics.regressor_gradient import RegressorSweep
from hil.excitation.motion import FourierSeries


class Slsqp:
    """Minimises log cond of some columns of a regressor over q₀, a and b of every joint.

    Args:
        robot: The arm.
        columns: Those of its regressor without rotors.
        limits: Of |q|, |qd| and |qdd|, the same for all joints.
        harmonics: Of the series.
        fundamental_hz: Of the series.
        points: Samples of one period: of the objective and of the limits.
    """

    def __init__(
        self,
        robot: RobotModel,
        columns: IntArray,
        limits: tuple[float, float, float],
        harmonics: int,
        fundamental_hz: float,
        points: int,
    ) -> None:
        self._robot, self._columns, self._f_hz = robot, columns, fundamental_hz
        order = np.arange(1.0, harmonics + 1)
        omega = 2.0 * np.pi * fundamental_hz * order
        phase = 2.0 * np.pi * np.outer(np.arange(points) / points, order)
        sin, cos, one = np.sin(phase), np.cos(phase), np.ones((points, 1))
        self._maps = (
            np.hstack([one, sin / omega, -cos / omega]),
            np.hstack([0 * one, cos, sin]),
            np.hstack([0 * one, -sin * omega, cos * omega]),
        )
        rest = np.zeros((2, 2 * harmonics + 1))
        rest[0, 1 : harmonics + 1], rest[1, harmonics + 1 :] = 1.0, order
        each = np.eye(robot.n)
        self._equal = np.kron(each, rest)
        rows = [sign * np.kron(each, m) for m in self._maps for sign in (1.0, -1.0)]
        self._unequal = np.vstack(rows)
        self._most = np.repeat(limits, 2 * robot.n * points)

    def minimise(self, start: FourierSeries, iterations: int, exact: bool) -> FourierSeries:
        """From a start; `exact` for our gradient, else SciPy's forward differences."""
        x = np.hstack([np.array(start.q0)[:, None], start.a, start.b]).ravel()
        rest = {"type": "eq", "fun": lambda x: self._equal @ x, "jac": lambda _: self._equal}
        within = {
            "type": "ineq",
            "fun": lambda x: self._most - self._unequal @ x,
            "jac": lambda _: -self._unequal,
        }
        found = minimize(
            self._value_and_gradient if exact else self._value,
            x,
            jac=exact or None,
            method="SLSQP",
            constraints=[rest, within],
            options={"maxiter": iterations},
        )
        return self._series(found.x)

    def _value(self, x: FloatArray) -> float:
        motion = self._motion(x)
        W = self._robot.regressor(*motion, rotor=False, columns=self._columns)
        size = np.linalg.svd(W, compute_uv=False)
        return float(np.log(size[0] / size[-1]))

    def _value_and_gradient(self, x: FloatArray) -> tuple[float, FloatArray]:
        sweep = RegressorSweep.of(self._robot, *self._motion(x))
        kept = sweep.columns[self._columns]
        U, size, Vt = np.linalg.svd(kept.reshape(len(kept), -1), full_matrices=False)
        by_kept = np.outer(U[:, 0] / size[0], Vt[0]) - np.outer(U[:, -1] / size[-1], Vt[-1])
        by_columns = np.zeros_like(sweep.columns)
        by_columns[self._columns] = by_kept.reshape(kept.shape)
        by = sweep.pull_back(by_columns)
        parts = [m.T @ one for m, one in zip(self._maps, by, strict=True)]
        return float(np.log(size[0] / size[-1])), np.sum(parts, axis=0).T.ravel()

    def _motion(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        free = x.reshape(self._robot.n, -1).T
        q, qd, qdd = (m @ free for m in self._maps)
        return q, qd, qdd

    def _series(self, x: FloatArray) -> FourierSeries:
        rows = x.reshape(self._robot.n, -1)
        half = 1 + (rows.shape[1] - 1) // 2
        a, b = (tuple(map(tuple, part.tolist())) for part in (rows[:, 1:half], rows[:, half:]))
        return FourierSeries(tuple(rows[:, 0].tolist()), a, b, self._f_hz)
