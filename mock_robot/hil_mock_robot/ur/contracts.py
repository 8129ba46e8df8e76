"""What the parts of the controller are to each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from hil.core import FloatArray

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

Setpoint = FloatArray
"""(3, 6): position [rad], velocity [rad/s] and acceleration [rad/s²] that the servo follows."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where in the text of a program something is.

    Attributes:
        line, column: From 1; column 1 where it is not known.
        token: What a controller calls it, `""` for prose.
    """

    line: int = 1
    column: int = 1
    token: str = ""


NOWHERE = Place()


class Motion(Protocol):
    """A motion under way; one call per tick of the controller."""

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """The next set-point, or None when the motion is over.

        Args:
            now: The present set-point, which was commanded for the tick before.
            scale: The speed slider, 0 to 1: how much of a tick of motion time passes.

        Returns:
            A new array. A motion that is over has come to rest: its last set-point stands still.
        """


class Program(Protocol):
    """A robot program: one call per tick as long as it plays.

    Attributes:
        name: What its `def` calls it.
    """

    name: str

    def begin(self, machine: Machine) -> None:
        """It is about to play."""

    def tick(self, machine: Machine) -> bool:
        """Do what is due in this tick; False when it is over."""

    def end(self, machine: Machine) -> None:
        """It is over, by itself or stopped; the machine brakes whatever still moves."""


class Link(Protocol):
    """The controller's end of one connection; never blocks.

    Attributes:
        peer: Address of the client.
    """

    peer: str

    @property
    def closed(self) -> bool:
        """Whether there is no connection any more."""

    @property
    def pending(self) -> int:
        """Bytes that wait for the client to read."""

    def send(self, data: bytes) -> None:
        """Send, or keep what the client does not take yet."""

    def close(self) -> None:
        """Send what can be sent at once, then hang up."""


class Session(Protocol):
    """One client's conversation."""

    @property
    def lossless(self) -> bool:
        """Whether accelerated time waits until this client has taken what it was sent."""

    def received(self, data: bytes) -> None:
        """Some bytes came, cut anywhere."""

    def ticked(self) -> None:
        """The controller has made a tick: send what is due."""

    def hung_up(self) -> None:
        """The connection is gone."""


class Service(Protocol):
    """What listens on one port.

    Attributes:
        port: TCP port, the one that UR clients expect.
    """

    port: int

    def accept(self, link: Link) -> Session:
        """A client has connected; may send at once."""
