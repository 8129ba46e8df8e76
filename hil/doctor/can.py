"""CAN interfaces of the kernel, as most adapters are."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

from hil.can import NETWORK, can_interfaces, is_up, up_command
from hil.doctor.finding import Finding

BITRATE = 1_000_000
"""Of the drives that hil knows, unless a station says otherwise [bit/s]."""


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
    names = can_interfaces(network)
    down = [name for name in names if not is_up(name, network)]
    if down:
        text = f"SocketCAN; {', '.join(down)} is down: {up_command(down[0], BITRATE)}"
        yield Finding("can", text, "note")
    else:
        yield Finding("can", f"SocketCAN; interfaces: {', '.join(names) or 'none'}")
