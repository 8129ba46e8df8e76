"""What is looked at before drives are trusted, with mock drives in another process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from hil.core.errors import RobotConnectionError, RobotFault
from hil.robot import Status
from hil.testing.moves import follow, move
from hil_drivers.cia402.axes_robot import AxesRobot
from hil_drivers.cia402.profile import TORQUE_BIT, AxisProfile
from tests.support.cia402_robot import options
from tests.support.mock_servers import MockCan, mock_can

pytestmark = [pytest.mark.wire, pytest.mark.timeout(120)]

PATIENT = ("--sync-patience-s", "0.5", "--start-q-deg", "0", "-30", "-60", "0", "30", "0")


@pytest.fixture(scope="module")
def mock() -> Iterator[MockCan]:
    with mock_can(*PATIENT) as running:
        yield running


@contextmanager
def axes(mock: MockCan, **more: Any) -> Iterator[AxesRobot]:
    made = AxesRobot("arm", "lab6", **options(mock, **({"pace": 0.5} | more)))
    try:
        made.connect()
        yield made
    finally:
        made.close()


def finding(robot: AxesRobot, name: str) -> Any:
    (found,) = (each for each in robot.checks() if each.name == name)
    return found


def test_drives_without_the_mode_in_their_process_data_are_in_it_all_the_same(
    mock: MockCan,
) -> None:
    with axes(mock, mapping="minimal") as robot:
        assert set(mock.state()["modes"]) == {8}
        assert "does not contain it" in finding(robot, "drives-enabled").message
        rows = robot.read()
        assert np.isfinite(rows["qd"]).all()
        assert not (rows["status"] & int(Status.MASKED)).any()


def test_torque_of_the_wrong_sign_is_refused_before_it_leads_the_arm(
    mock: MockCan, monkeypatch: pytest.MonkeyPatch
) -> None:
    sign = AxisProfile._sign

    def turned(axis: AxisProfile, bit: int) -> int:
        wrong = bit == TORQUE_BIT and axis.gear_ratio == 141
        return -sign(axis, bit) if wrong else sign(axis, bit)

    with axes(mock) as robot:
        assert finding(robot, "torque-sign").message.endswith("gravity in joint_2")
    monkeypatch.setattr(AxisProfile, "_sign", turned)
    with axes(mock) as robot:
        found = finding(robot, "torque-sign")
        assert found.passed
        assert "joint_2 measures" in found.message
        assert "No torque is sent in this mode" in found.message
    with (
        pytest.raises(RobotConnectionError, match=r"joint_2 measures.* the sign of torque"),
        axes(mock, trajectory_mode="cst"),
    ):
        pass


def test_a_wrong_unit_of_velocity_ends_the_first_motion(mock: MockCan) -> None:
    with (
        axes(mock, axes={"velocity_unit": "0.001 rpm"}) as robot,
        pytest.raises(RobotFault, match=r"velocity_unit or polarity .* is wrong"),
    ):
        follow(robot, move(robot, 0.4))


def test_an_arm_that_is_led_by_torque_stays_near_its_set_points(mock: MockCan) -> None:
    with axes(mock, trajectory_mode="cst", pace="free") as robot:
        follow(robot, move(robot, 0.4))
        rows = robot.read()
        assert not (rows["status"] & int(Status.FAULT)).any()
