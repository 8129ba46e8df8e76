"""A mock or simulator on this computer that is still starting: its ports are about to open.

A controller across a network that refuses is off or has the interface disabled: nothing to wait
for. On a loopback address the likely reason is `hil mock … &` a moment ago.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable
from typing import TypeVar

from hil.core import RobotConnectionError

STARTING_S = 10.0
"""How long a refused loopback connection is tried again: a busy machine takes 6 s to start the
mock [s]."""

AGAIN_S = 0.1

T = TypeVar("T")


def once_listening(host: str, connect: Callable[[], T], within_s: float | None = None) -> T:
    """What `connect` gives, tried again while a port of this computer refuses it.

    Args:
        host: IP address of the controller.
        connect: Raises `RobotConnectionError` because of a `ConnectionRefusedError`.
        within_s: Wall time this may take, by default `STARTING_S`.

    Raises:
        RobotConnectionError: What `connect` has raised last; at once where waiting is in vain.
    """
    until = time.monotonic() + (STARTING_S if within_s is None else within_s)
    while True:
        try:
            return connect()
        except RobotConnectionError as error:
            refused = isinstance(error.__cause__, ConnectionRefusedError)
            if not (refused and _is_here(host)) or time.monotonic() >= until:
                raise
        time.sleep(AGAIN_S)


def _is_here(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback
