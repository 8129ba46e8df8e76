"""Which robots are real is decided from the options of their drivers, before anything connects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.core import plugins
from hil.robot import Address, Capabilities, address_of, is_loopback
from hil.robot.ipc import facts_document, facts_from
from hil.robot.subprocess_robot import RobotProcess
from tests.support.kinematic_robot import KinematicRobot

NODES = {"nodes": [1, 2, 3, 4, 5, 6]}


def bus(interface: str, channel: str) -> dict[str, Any]:
    return {"bus": {"interface": interface, "channel": channel}, **NODES}


@pytest.mark.parametrize(
    ("driver", "model", "options", "real"),
    [
        ("mock", "ur5", {}, False),
        ("mock", "ur5", {"clock": "wall"}, False),
        ("ur", "ur5", {"address": "127.0.0.1"}, False),
        ("ur", "ur5", {"address": "127.8.9.1"}, False),
        ("ur", "ur5", {"address": "::1"}, False),
        ("ur", "ur5", {"address": "localhost"}, False),
        ("ur", "ur5", {"address": "192.168.0.5"}, True),
        ("ur", "ur5", {"address": "fe80::1"}, True),
        ("ur", "ur5", {"address": "ur5.lab"}, True),
        ("ur", "ur5", {"address": "localhost.localdomain"}, True),
        ("cia402", "lab6", bus("hil_unix", "can0"), False),
        ("cia402", "lab6", bus("virtual", "can0"), False),
        ("cia402", "lab6", bus("socketcan", "vcan0"), False),
        ("cia402", "lab6", bus("socketcan", "vcan_of_the_arm"), True),
        ("cia402", "lab6", bus("socketcan", "can0"), True),
        ("cia402", "lab6", bus("udp_multicast", "239.0.0.1"), True),
        ("twincat", "lab6", {"address": "127.0.0.1"}, False),
        ("twincat", "lab6", {"address": "127.0.0.1", "ams_net_id": "5.24.37.144.1.1"}, True),
        ("twincat", "lab6", {"address": "10.0.0.3", "ams_net_id": "5.24.37.144.1.1"}, True),
    ],
)
def test_drivers_know_whether_a_real_arm_may_hear_them(
    driver: str, model: str, options: dict[str, Any], real: bool
) -> None:
    robot = plugins.load("hil.drivers", driver)("arm", model, **options)
    try:
        assert address_of(robot).real is real
    finally:
        robot.close()


def test_no_name_is_resolved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.getaddrinfo", lambda *a, **k: pytest.fail("a name was resolved"))
    robot = plugins.load("hil.drivers", "ur")("arm", "ur5", address="ur5.lab")
    assert address_of(robot) == Address("ur5.lab")


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.3.2.1", "::1", "[::1]", "localhost", "LOCALHOST"]
)
def test_the_loopback_is_private(host: str) -> None:
    assert is_loopback(host)


@pytest.mark.parametrize(
    "host", ["", "127.1", "0.0.0.0", "127.0.0.1.lab", "localhost.", "lab", "::ffff:10.0.0.1"]
)
def test_what_is_not_literally_loopback_counts_as_elsewhere(host: str) -> None:
    assert not is_loopback(host)


class InWallTime(KinematicRobot):
    """Says nothing about its address."""

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(("a", "b", "c"), 100.0, "torque")


class Named(InWallTime):
    resource = "bench://7"


def test_a_driver_that_says_nothing_is_real_unless_its_clock_is_virtual() -> None:
    assert address_of(InWallTime()) == Address("unknown")
    assert address_of(Named()) == Address("bench://7")
    assert not address_of(KinematicRobot()).real


def test_a_driver_in_a_process_of_its_own_has_the_same_address() -> None:
    own = RobotProcess("mock", "ur5", "ur5", {})
    try:
        assert address_of(own) == Address("this process", real=False)
    finally:
        own.close()


def test_the_address_survives_the_line_to_a_drivers_process() -> None:
    robot = plugins.load("hil.drivers", "ur")("arm", "ur5", address="192.168.0.5")
    known = facts_from(facts_document(robot, connected=False))
    assert known.address == Address("192.168.0.5")
    assert np.isfinite(known.limits.qd_max).all()
