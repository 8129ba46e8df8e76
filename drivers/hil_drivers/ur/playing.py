"""Whether the robot program plays, as the rows of a reader tell."""

from __future__ import annotations

import contextlib
import time
from typing import Any

from hil.core import HilError, RobotFault, RobotTimeout
from hil_drivers.ur.rows import PLAYING

PLAYS_WITHIN_S = 5.0
LAST_ROW_S = 0.2


def wait_until_playing(receiver: Any, within_s: float = PLAYS_WITHIN_S) -> None:
    """Let go of rows from before the program was uploaded.

    `ur-rtde` holds the interpreter meanwhile, and comes back when its own connection says that the
    program plays: what came over ours may still wait to be heard.

    Args:
        receiver: Gives the controller's rows.
        within_s: Wall time this may take.

    Raises:
        RobotTimeout: No row came.
        RobotFault: The program does not play.
    """
    until = time.monotonic() + within_s
    while int(receiver.take(1.0)[-1]["runtime_state"]) != PLAYING:
        if time.monotonic() > until:
            raise RobotFault(
                "the robot program does not play after it was uploaded",
                hint="look for a message at the teach pendant, then connect again",
            )


def state_of(receiver: Any) -> int:
    """RTDE `runtime_state` by now; of a program that plays when nobody can tell."""
    with contextlib.suppress(HilError):
        with contextlib.suppress(RobotTimeout):
            receiver.take(0.0)
        return int(receiver.take(LAST_ROW_S)[-1]["runtime_state"])
    return PLAYING
