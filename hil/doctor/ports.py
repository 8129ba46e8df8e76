"""TCP ports that this computer would listen on."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from hil.doctor.finding import Finding

LOOPBACK = "127.0.0.1"

PORTS = {
    "dashboard": ((8350,), "hil serve takes one of the next"),
    "live view": ((8765,), "hil run --live takes one of the next"),
    "mock ur": ((29999, 30001, 30002, 30003, 30004), "hil mock ur cannot start beside it"),
    "mock plc": ((48898,), "hil mock plc cannot start beside it"),
}
"""For what, which ones, and what follows when one is taken."""


def free() -> Iterator[Finding]:
    """Which ports of `hil` somebody listens on already; a mock of ours that runs is one."""
    for what, (numbers, follows) in PORTS.items():
        taken = [str(number) for number in numbers if _taken(number)]
        if taken:
            yield Finding(f"ports {what}", f"{', '.join(taken)} in use: {follows}", "note")
        else:
            yield Finding(f"ports {what}", f"{', '.join(map(str, numbers))} free on loopback")


def _taken(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            line.bind((LOOPBACK, port))
        except OSError:
            return True
    return False
