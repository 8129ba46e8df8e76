"""Plays a motion to the drives row by row, brakes on its way, and holds where it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hil.errors import CommandRefused
from hil.robot import Status
from hil.typing import IntArray
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.contracts import Inputs, Outputs

FADE_S = 0.5
"""A step in the feed-forward torque (a model that is off, a mode switch) goes over this time."""

LONGEST_STOP_S = 5.0
MOVING, HOLDING = int(Status.MOVING), int(Status.HOLDING)
_HALF, _WHOLE = 1 << 31, 1 << 32


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A motion as the drives take it, one row per cycle.

    Attributes:
        segment: Index of the plan's step.
        position: (N, n) of 607Ah, N ≥ 1; begins where the drives hold.
        velocity: (N, n) of 60FFh.
        torque: (N, n) feed-forward, ‰ as 6071h and 60B2h.
    """

    segment: int
    position: IntArray
    velocity: IntArray
    torque: IntArray


@dataclass(frozen=True, slots=True)
class Gains:
    """Position control by the master in CST: torque = feed-forward + kp·e + kd·ė, per axis.

    Attributes:
        kp: ‰ of rated torque per increment of position.
        kd: ‰ of rated torque per count of velocity.
        limit: Largest torque commanded [‰].
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    limit: tuple[float, ...]


class Player:
    """The commanded motion of all axes; one `step` a cycle, by the cyclic thread.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis, of position; its sign does not matter.
        feed_forward: Send the track's torque as 60B2h in CSP.
        gains: For CST.

    Attributes:
        segment, status: Of the row commanded last: the plan's step and `Status` bits.
        position, velocity, torque: The same row, raw.
        mode: What is played: CSP, CSV or CST; 0 while the drives are not enabled.
    """

    def __init__(
        self,
        period_s: float,
        rad_per_increment: Sequence[float],
        *,
        feed_forward: bool = False,
        gains: Gains | None = None,
    ) -> None:
        self._period_s, self._scale = period_s, [abs(rad) for rad in rad_per_increment]

    @property
    def moving(self) -> bool:
        """Whether set-points of a motion are left, or it brakes."""

    def load(self, track: Track) -> None:
        """Keep the next motion for `start`; from any thread.

        Raises:
            CommandRefused: It does not begin where the arm is held.
        """

    def start(self) -> None:
        """Begin with the next cycle.

        Raises:
            CommandRefused: Nothing is loaded, or the last motion goes on.
        """

    def stop(self, deceleration_rad_s2: float) -> None:
        """Come to rest on the rest of the way, slower and slower, and hold there. Idempotent."""

    def hold(self) -> None:
        """Be done with the motion at once and hold the set-point commanded last."""
