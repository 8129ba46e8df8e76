"""The contract of a robot, kept by the TwinCAT driver over real ADS frames, by unmodified pyads."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.testing.driver_conformance import Bench, robot_conformance
from hil_drivers.twincat.robot import TwinCatRobot
from tests.support.mock_servers import MockPlc, mock_plc

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

STOP_RAD_S2 = 8.0


def first_stop(running: MockPlc, asked: float) -> float | None:
    stops = (float(line["monotonic_s"]) for line in running.journal("stop"))
    return next((at for at in stops if at >= asked), None)


def test_the_driver_keeps_the_contract_of_a_robot(tmp_path: Path) -> None:
    with mock_plc(tmp_path, "--speed", "6") as running:
        bench = Bench(
            move_ramp_rad_s2=STOP_RAD_S2,
            trajectory_ramp_rad_s2=STOP_RAD_S2,
            stop_seen=lambda asked: first_stop(running, asked),
            fault=lambda robot: running.side(kind="drive_fault"),
        )
        done = robot_conformance(
            lambda: TwinCatRobot("arm", "lab6", address=running.address), bench=bench
        )
    assert {"a_stop_is_on_the_wire_in_time", "a_fault_surfaces_in_the_next_read"} <= set(done)
