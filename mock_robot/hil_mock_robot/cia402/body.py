"""The arm under the drives: demands of six axes in, what they measure out, at steps of 1 ms."""

from __future__ import annotations

from collections.abc import Sequence

from hil.arms import ArmDescription
from hil.payload import Payload
from hil.typing import FloatArray
from hil_mock_robot.cia402.contracts import Demand, Measured
from hil_mock_robot.draw import published
from hil_mock_robot.mounting import MOUNTS
from hil_mock_robot.truth import Truth


class Body:
    """One drawn arm on its brakes, until drives say otherwise.

    Args:
        truth: What it is really like.
        q: (n,) where it stands when it is switched on [rad].
        gravity: In the base frame [m/s²].
        substep_hz: Integration steps per second.
        mounted: What hangs at the flange; nothing when None.
        temperature_c: Of the joints at the start; the room's when None.

    Attributes:
        arm: What is published about it.
        seen: What the axes measured last, from the start on.
        faults: By axis, the EMCY codes that the last block of steps has brought.
    """

    def __init__(
        self,
        truth: Truth,
        q: FloatArray,
        *,
        gravity: tuple[float, float, float] = MOUNTS["table"],
        substep_hz: float = 1000.0,
        mounted: Payload | None = None,
        temperature_c: float | None = None,
    ) -> None:
        self.arm: ArmDescription = published(truth.arm)
        self.seen: list[Measured] = []
        self.faults: dict[int, int] = {}

    def advance(self, demands: Sequence[Demand]) -> list[Measured]:
        """Let the arm do what its axes demand, each for the same number of steps."""
        raise NotImplementedError

    def mount(self, payload: Payload) -> None:
        """Hang something to the flange."""
        raise NotImplementedError

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        raise NotImplementedError

    def heat(self, axis: int, celsius: float) -> None:
        """Set the temperature of one motor [°C]."""
        raise NotImplementedError

    @property
    def fastest(self) -> float:
        """Largest true joint speed [rad/s]."""
        raise NotImplementedError
