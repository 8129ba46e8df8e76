"""Pinocchio's inverse dynamics alone, without friction or network: directly, and through hil."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from benchmarks.prediction.clock import timed, told
from hil.core.typing import FloatArray
from hil.dynamics import RobotModel
from hil.export.agreement import RATE_HZ, SAMPLES, motion


def timed_pinocchio(robot: RobotModel, calls: int) -> dict[str, float]:
    """Measure `pinocchio_rnea` and `pinocchio_through_hil`, and their difference."""
    direct, through = _direct(robot), _through_hil(robot)
    rows = list(zip(*motion(robot, SAMPLES, RATE_HZ), strict=True))
    one, other = (np.array([step(*row) for row in rows]) for step in (direct, through))
    apart = float(np.max(np.abs(one - other) / np.abs(other).max(axis=0)))
    figures: dict[str, float] = {}
    for name, step in (("pinocchio_rnea", direct), ("pinocchio_through_hil", through)):
        figures |= told(name, timed(step, robot, calls)) | {f"{name}_off_by": apart}
    return figures


def _direct(robot: RobotModel) -> Callable[..., FloatArray]:
    model = robot._model  # noqa: SLF001  # there is no other way to it
    data = model.createData()

    def step(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        return np.array(pin.rnea(model, data, q, qd, qdd))

    return step


def _through_hil(robot: RobotModel) -> Callable[..., FloatArray]:
    def step(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        torque: FloatArray = robot.inverse_dynamics(q[None], qd[None], qdd[None])[0]
        return torque

    return step
