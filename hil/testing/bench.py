"""What the checks of a driver have beside the robot: who sees its wire, who can make it fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hil.robot import Robot


@dataclass(frozen=True, slots=True)
class Bench:
    """Where a driver is tested.

    Attributes:
        move_ramp_rad_s2: Deceleration of the last joint when a move is stopped [rad/s²].
        trajectory_ramp_rad_s2: The same when a trajectory is stopped.
        stop_seen: Given a moment of `time.monotonic`, when the first stop after it came to the
            controller, by the same clock; None while there is none. A mock's journal can tell, or
            a listener on the wire.
        fault: Makes the robot, which moves, fault: by a mock's side channel, or a person who
            presses the button when asked.
    """

    move_ramp_rad_s2: float = 2.0
    trajectory_ramp_rad_s2: float = 2.0
    stop_seen: Callable[[float], float | None] | None = None
    fault: Callable[[Robot], object] | None = None
