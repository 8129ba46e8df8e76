"""Where the commands of a robot go, and whether a real arm may hear them."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from hil.robot.protocol import HasResource, Robot

UNKNOWN = "unknown"
"""Text of the address of a real robot whose driver states none."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where the commands of a robot go.

    Attributes:
        text: For people, such as `192.168.0.5` or `socketcan can0`.
        real: Whether something outside this computer may hear them: such a robot moves only after
            a confirmation. False for mocks, loopback addresses and virtual buses.
    """

    text: str
    real: bool = True


@runtime_checkable
class HasAddress(Protocol):
    """What a robot also offers when it knows, before `connect`, where its commands go.

    A robot in wall time without it counts as real.
    """

    @property
    def address(self) -> Address:
        """From the options alone: no name is resolved and nothing is connected."""


def address_of(robot: Robot) -> Address:
    """Return where the commands of a robot go; it need not be connected."""
    if isinstance(robot, HasAddress):
        return robot.address
    if robot.capabilities.clock == "virtual":
        return Address("this process", real=False)
    return Address(robot.resource if isinstance(robot, HasResource) else UNKNOWN)


def is_loopback(host: str) -> bool:
    """Return whether a host is this computer by its very text: 127.0.0.0/8, ::1, localhost.

    Other names may lead here, too, but who resolves them may change; they count as elsewhere.
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
