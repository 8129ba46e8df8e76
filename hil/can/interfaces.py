"""CAN interfaces of the kernel, as most adapters are: which there are, and which are up.

Read from what the kernel tells everybody: no rights are needed, and nothing is opened or sent.
"""

from __future__ import annotations

from pathlib import Path

NETWORK = Path("/sys/class/net")
"""Where the kernel lists its interfaces."""

IFF_UP = 0x1
ARPHRD_CAN = 280
"""What the kernel calls a CAN interface in `type`."""


def can_interfaces(network: Path = NETWORK) -> list[str]:
    """Names of all CAN interfaces, up or down."""
    return [p.name for p in sorted(network.glob("*")) if _number(p / "type", 10) == ARPHRD_CAN]


def is_up(name: str, network: Path = NETWORK) -> bool | None:
    """Whether an interface is switched on; None where there is none of that name.

    Adapters are pulled while somebody looks: one that vanishes meanwhile is not there.
    """
    flags = _number(network / name / "flags", 16)
    return None if flags is None else bool(flags & IFF_UP)


def up_command(name: str, bitrate: int) -> str:
    """What switches an interface on.

    Args:
        name: Of the interface.
        bitrate: Bits per second of classic CAN [bit/s].
    """
    return f"sudo ip link set {name} up type can bitrate {bitrate}"


def _number(file: Path, base: int) -> int | None:
    try:
        return int(file.read_text("utf-8"), base)
    except (OSError, ValueError):
        return None
