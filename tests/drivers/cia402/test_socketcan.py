"""The same arm on SocketCAN: a virtual interface of the kernel, where it has one."""

import socket
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from hil.testing.moves import follow, move
from hil_drivers.cia402.robot import Cia402Robot
from tests.support.mock_servers import mock_can

INTERFACE = "vcan0"


def missing() -> str:
    """Why SocketCAN cannot be tried here; empty when it can."""
    if not hasattr(socket, "AF_CAN"):
        return "this Python knows no AF_CAN"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return f"this kernel has no CAN: {error.strerror}"
    up = INTERFACE in [name for _, name in socket.if_nameindex()]
    return (
        "" if up else f"no interface: ip link add {INTERFACE} type vcan; ip link set {INTERFACE} up"
    )


pytestmark = [pytest.mark.wire, pytest.mark.skipif(bool(missing()), reason=missing())]


def test_an_arm_on_socketcan_follows(tmp_path: Path) -> None:
    side = str(tmp_path / "side")
    bus = {"interface": "socketcan", "channel": INTERFACE}
    with (
        mock_can("--interface", "socketcan", "--side", side, channel=INTERFACE),
        closing(Cia402Robot("arm", "lab6", bus=bus, late_cycles=50)) as robot,
    ):
        robot.connect()
        rows = follow(robot, move(robot, 0.1))
    assert np.abs(rows["q"] - rows["q_target"]).max() < 0.01
