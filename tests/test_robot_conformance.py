"""Every robot here keeps the contract of `hil.robot.Robot`, and the checks find who does not."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kinematic_robot import KinematicRobot

from hil.robot import Capabilities, Limits, Robot, Segment
from hil.robot.process import RobotProcess
from hil.testing.conformance import NotConforming, robot_conformance
from hil.testing.robot_checks import BEFORE_AND_AFTER, CONNECTED
from hil.typing import StructArray
from hil_mock_robot.driver import MockRobot


def embedded_mock() -> Robot:
    return MockRobot("bench", "ur5")


def mock_in_wall_time() -> Robot:
    return MockRobot("bench", "ur5", clock="wall")


def kinematic_in_its_own_process() -> Robot:
    return RobotProcess("process_drivers:Kinematic", "bench", "ur5")


def mock_in_wall_time_in_its_own_process() -> Robot:
    return RobotProcess("mock", "bench", "lab6", {"clock": "wall"})


def other_arm_in_its_own_process() -> Robot:
    return RobotProcess("process_drivers:WallArm", "bench", "ur5")


@pytest.mark.parametrize(
    "make_robot", [KinematicRobot, embedded_mock, kinematic_in_its_own_process]
)
def test_a_robot_on_a_virtual_clock_conforms(make_robot: Callable[[], Robot]) -> None:
    assert len(robot_conformance(make_robot)) == len(BEFORE_AND_AFTER) + len(CONNECTED)


PRIVATE = ["a_robot_in_wall_time_says_which_one_it_is"]
"""Nobody outside its process can reach a mock in wall time."""


@pytest.mark.wire
@pytest.mark.parametrize(
    ("make_robot", "leave_out"),
    [
        (mock_in_wall_time, PRIVATE),
        (mock_in_wall_time_in_its_own_process, PRIVATE),
        (other_arm_in_its_own_process, []),
    ],
)
def test_a_robot_in_wall_time_conforms(
    make_robot: Callable[[], Robot], leave_out: list[str]
) -> None:
    done = robot_conformance(make_robot, leave_out=leave_out)
    assert len(done) == len(BEFORE_AND_AFTER) + len(CONNECTED) - len(leave_out)


class SlowToStop(KinematicRobot):
    def stop(self) -> None:
        time.sleep(0.12)
        super().stop()


class StopsNothing(KinematicRobot):
    def stop(self) -> None:
        return


class NamesNoSegment(KinematicRobot):
    def read(self, timeout_s: float = 1.0) -> StructArray:
        block = super().read(timeout_s)
        block["segment"] = -1
        return block


class RepeatsItself(KinematicRobot):
    def read(self, timeout_s: float = 1.0) -> StructArray:
        block = super().read(timeout_s)
        block["device_time"][1] = block["device_time"][0]
        return block


class GoesElsewhere(KinematicRobot):
    def prepare(self, segment: Segment) -> None:
        super().prepare(replace(segment, q=segment.q + 0.05))


class ClosesBadly(KinematicRobot):
    def close(self) -> None:
        if not self.connected:
            raise OSError("closed already")
        super().close()


class TalksAfterClosing(KinematicRobot):
    def close(self) -> None:
        return


class ForgetsThePayload(KinematicRobot):
    def set_payload(self, payload: Any) -> Any:
        return type(payload)()


class KnowsNoLimit(KinematicRobot):
    @property
    def limits(self) -> Limits:
        return replace(super().limits, effort_max=np.array([10.0, 10, 10, 10, 10, np.inf]))


class InWallTime(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, clock="wall")


class NamesNoAddress(InWallTime):
    resource = " "


class LacksGains(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return replace(super().capabilities, drive_gains=(8.0, 8.0, 8.0, 8.0, 8.0, 0.0))


@pytest.mark.parametrize(
    ("robot", "check"),
    [
        (KnowsNoLimit, "every_joint_has_limits_and_gains"),
        (InWallTime, "a_robot_in_wall_time_says_which_one_it_is"),
        (NamesNoAddress, "a_robot_in_wall_time_says_which_one_it_is"),
        (LacksGains, "every_joint_has_limits_and_gains"),
        (SlowToStop, "stop_works_before_connecting"),
        (SlowToStop, "stop_works_at_rest_and_again"),
        (StopsNothing, "stop_ends_a_motion"),
        (NamesNoSegment, "a_move_ends_where_it_was_told"),
        (RepeatsItself, "rows_are_state_rows_in_order"),
        (GoesElsewhere, "a_move_ends_where_it_was_told"),
        (ClosesBadly, "a_closed_robot_is_gone"),
        (TalksAfterClosing, "a_closed_robot_is_gone"),
        (ForgetsThePayload, "the_payload_is_read_back"),
    ],
)
def test_a_robot_that_breaks_the_contract_is_found(robot: type[KinematicRobot], check: str) -> None:
    with pytest.raises(NotConforming) as caught:
        robot_conformance(robot)
    assert check in caught.value.failures


def test_a_check_can_be_left_out() -> None:
    done = robot_conformance(ForgetsThePayload, leave_out=["the_payload_is_read_back"])
    assert "the_payload_is_read_back" not in done


def test_the_checks_need_no_pytest() -> None:
    code = "import sys, hil.testing.conformance; assert 'pytest' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
