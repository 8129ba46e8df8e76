"""In which rows an arm moves, or is told to: what is not measured matters there."""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, StructArray
from hil.robot import Status


def moving(block: StructArray, before: StructArray | None) -> BoolArray:
    """(N,) rows that say `MOVING`, or whose set-point is another one than a row earlier.

    A driver that forgets `MOVING` must not keep an interlock from seeing that a sensor is dead.

    Args:
        block: State rows (N,).
        before: The block before it, None for the first one.
    """
    target = block["q_target"]
    first = target[:1] if before is None or not len(before) else before["q_target"][-1:]
    # A set-point that the robot does not report is NaN, and says nothing: NaN is not above 0.
    steps = np.abs(np.diff(target, axis=0, prepend=first))
    stepped = np.any(steps > 0, axis=1)
    moves: BoolArray = np.logical_or(stepped, block["status"] & Status.MOVING)
    return moves
