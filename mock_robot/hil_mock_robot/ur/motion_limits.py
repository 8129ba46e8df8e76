"""Checks for impossible motions: targets beyond a joint range, singularities, non-finite numbers.

All checks raise `MotionImpossible`, with UR's code of a protective stop if UR has a code for the
cause.
"""

from __future__ import annotations

import numpy as np

from hil.arms import ArmDescription
from hil.core import CommandRefused, FloatArray

JOINT_LIMITS, SINGULARITY, SUDDEN_CHANGE = 150, 154, 204

STOP_TEXTS = {
    JOINT_LIMITS: "Position close to joint limits",
    SINGULARITY: "Position in singularity",
    SUDDEN_CHANGE: "Path sanity check: Sudden change in target position",
}
"""UR's error codes C… for impossible motions, with UR's description.

Source: The source of the codes is Universal Robots, "Service Manual", chapter on error codes.
"""


class MotionImpossible(CommandRefused):
    """Error of a motion that cannot begin or continue; raised only during `Motion.advance`.

    Args:
        text: Message as the teach pendant would show it.
        code: UR's code of a protective stop; 0 for a runtime error of the program.
        hint: Remedy for the user.

    Attributes:
        text, code: Message with the description of the code, and the code itself.
    """

    def __init__(self, text: str, code: int = 0, *, hint: str = "") -> None:
        named = f"C{code}: {STOP_TEXTS[code]}: {text}" if code else text
        super().__init__(named, hint=hint or "command a motion that the arm can make")
        self.text, self.code = named, code


TOLERANCE_RAD = 1e-6


def require_within(arm: ArmDescription, q: FloatArray) -> None:
    """Raise if a target (6,) [rad] is beyond the joint limits.

    Raises:
        MotionImpossible: A joint is beyond its limits; the code is 150.
    """
    beyond = (q > arm.q_max + TOLERANCE_RAD) | (q < arm.q_min - TOLERANCE_RAD)
    if beyond.any():
        raise out_of_range(arm, int(beyond.argmax()))


def out_of_range(arm: ArmDescription, joint: int) -> MotionImpossible:
    """Return the error for a joint that would leave its range."""
    low, high = arm.q_min[joint], arm.q_max[joint]
    return MotionImpossible(
        f"joint {joint + 1} must stay between {low:.4f} and {high:.4f} rad", JOINT_LIMITS
    )


def require_finite(*numbers: float | FloatArray) -> None:
    """Raise if a number is not finite.

    Raises:
        MotionImpossible: A number is infinite or NaN; the code is 204.
    """
    if not all(np.isfinite(each).all() for each in numbers):
        raise MotionImpossible("a target is not a finite number", SUDDEN_CHANGE)


def joint_leaving_range(arm: ArmDescription, q: FloatArray, qd: FloatArray) -> int | None:
    """Return the index of a joint beyond its range that moves further out, or None."""
    beyond = (q > arm.q_max + TOLERANCE_RAD) & (qd > 0)
    beyond |= (q < arm.q_min - TOLERANCE_RAD) & (qd < 0)
    return int(beyond.argmax()) if beyond.any() else None
