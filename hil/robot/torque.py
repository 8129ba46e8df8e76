"""Robots that may be driven by torque: simulated ones, which say so."""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from hil.core import FloatArray


@runtime_checkable
class TorqueControlled(Protocol):
    """What a simulated robot also offers when its joints can be driven by torque and pushed.

    For simulated arms alone: `hil` commands torque to no real robot, whatever that could do.
    `hil try-out` uses it: `command_torque`, `push`, `read`, one sample after the other.

    Attributes:
        simulated: True on the class itself, and only where no arm can move. Methods of these
            names are not enough: drivers of real arms may have them for reasons of their own.
    """

    simulated: ClassVar[bool]

    def command_torque(self, torque: FloatArray | None) -> None:
        """Drive the joints by torque (n,) [N·m] until told otherwise; None brakes and holds."""

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""


def is_simulated(driver: object) -> bool:
    """Whether a robot, or its driver before it is opened, says that torque moves no real arm."""
    return getattr(driver, "simulated", None) is True and all(
        hasattr(driver, member) for member in ("command_torque", "push")
    )
