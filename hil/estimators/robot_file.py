"""The robot model inside a model folder: how it was made, and a copy of its URDF if it has one.

Of an arm that a file of one's own describes, it has the SHA-256 of what that file says.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import require_same_arm
from hil.core import DataError, FitError, SpecError
from hil.dynamics import MOTOR_SIDE, RobotModel

URDF_FILE = "robot.urdf"


def store_robot(robot: RobotModel) -> tuple[dict[str, Any], bytes | None]:
    """What `model.json` says about the robot, and the URDF to be stored beside it.

    Raises:
        FitError: The URDF is gone, or the robot is not what its description leads to (the file
            was changed since, say), so the stored model would predict something else.
    """
    document = robot.to_dict()
    content = None
    if document["kind"] == "urdf":
        try:
            content = Path(robot.name).read_bytes()
        except OSError as error:
            raise FitError(f"cannot store the robot's URDF: {error}") from error
    _require_same(robot, document)
    if robot.arm is not None and robot.arm.sha256:
        document["model_sha256"] = robot.arm.sha256
    return document, content


def restore_robot(document: dict[str, Any], folder: Path) -> RobotModel:
    """The robot model a folder was stored with: mounting, rotor inertias and loads included.

    Raises:
        DataError: Its built-in arm or URDF cannot be used here, or the file that describes its arm
            was changed since.
        KeyError, TypeError, ValueError: The document is damaged.
    """
    if document["kind"] == "urdf":
        document = document | {"name": str(folder / URDF_FILE)}
    else:
        own = {**document, "model": str(document["name"]).removesuffix(MOTOR_SIDE)}
        require_same_arm(own, folder, "fit the model again")
    try:
        return RobotModel.from_dict(document)
    except SpecError as error:
        raise DataError(f"{folder}: {error.message}", hint=error.hint) from error


def _require_same(robot: RobotModel, document: dict[str, Any]) -> None:
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, robot.n))
    again = RobotModel.from_dict(document)
    pairs = [
        (robot.gravity_regressor(q), again.gravity_regressor(q)),
        (robot.parameters(), again.parameters()),
    ]
    if any(ours.shape != theirs.shape or not np.allclose(ours, theirs) for ours, theirs in pairs):
        raise FitError(
            f"the robot model differs from what {robot.name} leads to when it is loaded again, so "
            "the fitted model cannot be stored",
            hint="load the robot from its file again and fit again",
        )
