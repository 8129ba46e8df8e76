"""The file that describes an arm of one's own: whether it is still the one of a run or model."""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from hil.arms.description import arm_names, is_description, load_arm
from hil.errors import DataError, SpecError


def model_sha256(model: str) -> str:
    """SHA-256 of the file that a robot's `model` names, as this process has read it.

    Returns:
        Hexadecimal; empty for a built-in arm.

    Raises:
        SpecError: The file cannot be used.
    """
    if model in arm_names():
        return ""
    if is_description(model):
        return load_arm(model).sha256
    try:
        return sha256(Path(model).read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None


def require_same_arm(
    robot: Mapping[str, Any], source: Path, otherwise: str, *, gone: bool = False
) -> None:
    """Refuse what was made with an arm whose file was changed since.

    Args:
        robot: What a run's start document says about the robot, or a model's about its arm; one
            that has no digest passes.
        source: The run or model, for the message.
        otherwise: What else can be done.
        gone: A file that cannot be read passes as well: nobody can mistake it for the arm.

    Raises:
        DataError: The file is gone, or is not what it was.
    """
    recorded, model = robot.get("model_sha256"), str(robot.get("model", ""))
    if not recorded:
        return
    try:
        found = model_sha256(model)
    except SpecError as error:
        if gone:
            return
        raise DataError(error.message, hint=f"put {model} back, or {otherwise}") from None
    if found != recorded:
        raise DataError(
            f"{model} describes another arm than when {source} was made: its SHA-256 is now "
            f"{found[:12]}…, and was {str(recorded)[:12]}…",
            hint=f"put the original file back, or {otherwise}",
        )
