"""The robot model inside a model folder: a built-in arm by name, or a copy of its URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.dynamics import RobotModel, load_model
from hil.errors import DataError, FitError, SpecError

URDF_FILE = "robot.urdf"


def store_robot(robot: RobotModel) -> tuple[dict[str, Any], bytes | None]:
    """What `model.json` says about the robot, and the URDF to be stored beside it.

    Raises:
        FitError: The URDF is gone, or the robot is not what its name or file leads to (mounted
            at another angle, say), so the stored model would predict something else.
    """
    document: dict[str, Any] = {"name": robot.name, "joint_names": list(robot.joint_names)}
    content = None
    if robot.arm is None:
        try:
            content = Path(robot.name).read_bytes()
        except OSError as error:
            raise FitError(f"cannot store the robot's URDF: {error}") from error
    _require_same(robot)
    return document | {"kind": "urdf" if content is not None else "arm"}, content


def restore_robot(document: dict[str, Any], folder: Path) -> RobotModel:
    """The robot model a folder was stored with.

    Raises:
        DataError: Its built-in arm or URDF cannot be used here.
    """
    urdf = document["kind"] == "urdf"
    try:
        return load_model(folder / URDF_FILE if urdf else document["name"])
    except SpecError as error:
        raise DataError(f"{folder}: {error.message}", hint=error.hint) from error


def _require_same(robot: RobotModel) -> None:
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, robot.n))
    again = load_model(robot.name)
    W, W_again = robot.gravity_regressor(q), again.gravity_regressor(q)
    if W.shape != W_again.shape or not np.allclose(W, W_again):
        raise FitError(
            f"the robot model differs from {robot.name} as it is loaded by name, so the fitted "
            "model cannot be stored",
            hint="describe the mounting in a URDF and load that",
        )
