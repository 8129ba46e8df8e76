"""The file that describes an arm of one's own: whether it is still the one of a run or model."""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from hil.arms.content import urdf_sha256
from hil.arms.description import arm_names, is_description, load_arm
from hil.core import DataError, SpecError


def model_sha256(model: str) -> str:
    """SHA-256 of what the file that a robot's `model` names says, as this process has read it.

    Returns:
        Hexadecimal, see `hil.arms.content`; empty for a built-in arm.

    Raises:
        SpecError: The file cannot be used.
    """
    return _digests(model)[0]


def _digests(model: str) -> tuple[str, str]:
    """Of what the file says, and of its bytes, which runs and models had at first."""
    if model in arm_names():
        return "", ""
    if is_description(model):
        arm = load_arm(model)
        return arm.sha256, arm.file_sha256
    try:
        content = Path(model).read_bytes()
        return urdf_sha256(content), sha256(content).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None


def require_same_arm(
    robot: Mapping[str, Any], source: Path, otherwise: str, *, gone: bool = False
) -> None:
    """Refuse what was made with an arm whose file says something else since.

    Args:
        robot: What a run's start document says about the robot, or a model's about its arm; one
            that has no digest passes.
        source: The run or model, for the message.
        otherwise: What else can be done.
        gone: A file that cannot be read passes as well: nobody can mistake it for the arm.

    Raises:
        DataError: The file is gone, or does not say what it said.
    """
    recorded, model = robot.get("model_sha256"), str(robot.get("model", ""))
    if not recorded:
        return
    try:
        found = _digests(model)
    except SpecError as error:
        if gone:
            return
        raise DataError(error.message, hint=f"put {model} back, or {otherwise}") from None
    if recorded not in found:
        raise DataError(
            f"{model} describes another arm than when {source} was made: its SHA-256 is now "
            f"{found[0][:12]}…, and was {str(recorded)[:12]}…",
            hint=f"put the original file back, or {otherwise}",
        )
