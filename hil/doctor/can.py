"""CAN interfaces of the kernel, as most adapters are."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

from hil.doctor.finding import Finding

NETWORK = Path("/sys/class/net")
IFF_UP = 0x1
ARPHRD_CAN = 280
"""What the kernel calls a CAN interface in `type`."""

UP = "sudo ip link set {name} up type can bitrate 1000000"


def interfaces(network: Path = NETWORK) -> Iterator[Finding]:
    """Whether the kernel has CAN at all, and which interfaces are up.

    Args:
        network: Where the kernel lists its interfaces.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        text = "this kernel has no CAN (AF_CAN): mock drives and adapters with a python-can driver"
        yield Finding("can", f"{text} of their own work, SocketCAN does not", "note")
        return
    names = [path.name for path in sorted(network.glob("*")) if _is_can(path)]
    down = [name for name in names if not is_up(name, network)]
    if down:
        text = f"SocketCAN; {', '.join(down)} is down: {UP.format(name=down[0])}"
        yield Finding("can", text, "note")
    else:
        yield Finding("can", f"SocketCAN; interfaces: {', '.join(names) or 'none'}")


def is_up(name: str, network: Path = NETWORK) -> bool:
    """Whether an interface of the kernel is there and switched on; no rights are needed."""
    try:
        return bool(int((network / name / "flags").read_text("utf-8"), 16) & IFF_UP)
    except (OSError, ValueError):
        return False


def _is_can(path: Path) -> bool:
    try:
        return int((path / "type").read_text("utf-8")) == ARPHRD_CAN
    except (OSError, ValueError):
        return False
