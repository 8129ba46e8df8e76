"""A bus of a test's own: channels in short folders, and hubs that a thread serves.

In a test module: `from canbus_parts import bus_hub, can_channel  # noqa: F401` makes them fixtures.
"""

from __future__ import annotations

import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from hil.can.frames import FRAME, pack_frame
from hil.can.hub import HostedHub, Hub, hub_thread


@pytest.fixture
def can_channel() -> Iterator[str]:
    """The path of a channel nobody hosts; `tmp_path` may be too long for a socket."""
    with tempfile.TemporaryDirectory(prefix="hil-can-") as folder:
        yield str(Path(folder) / "can.sock")


@pytest.fixture
def bus_hub(can_channel: str) -> Iterator[HostedHub]:
    """A bus at `can_channel`, hosted by a thread."""
    with hub_thread(can_channel) as hub:
        yield hub


def unix_bus(channel: object) -> can.BusABC:
    """One more participant, opened the way users do."""
    return can.Bus(interface="hil_unix", channel=str(channel))


def raw_end(channel: object) -> socket.socket:
    """A participant without python-can; its reads give up after a second."""
    end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    end.connect(str(channel))
    end.settimeout(1.0)
    return end


def frame(can_id: int, number: int = 0) -> bytes:
    """A packet that carries a number."""
    return pack_frame(can_id, number.to_bytes(8, "little"))


def numbers(end: socket.socket, n: int) -> list[int]:
    """What the next frames carry."""
    return [int.from_bytes(FRAME.unpack(end.recv(FRAME.size))[2], "little") for _ in range(n)]


def serve_until_idle(hub: Hub, within_s: float = 5.0) -> None:
    """Serve a hub nobody else serves until it has nothing to do."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        before = time.perf_counter()
        hub.serve(0.005)
        if time.perf_counter() - before > 0.004 and hub.due_s is None:
            return
    raise AssertionError("the hub does not come to rest")
