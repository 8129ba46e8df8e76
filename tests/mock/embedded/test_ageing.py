"""The same robot on another day, in another room, or worn."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil_mock_robot.embedded.robot import MockRobot

SHOULDER = 1


def rows(**options):
    robot = MockRobot("aged", "ur5", seed=1, **options)
    robot.connect()
    found = np.concatenate([robot.read() for _ in range(8)])
    robot.close()
    return found


def moved(**options):
    """Effort at the pan's steady speed, where nothing but friction takes it."""
    robot = MockRobot("aged", "ur5", seed=1, profile="ideal", rate_hz=125, **options)
    robot.connect()
    robot.command_torque(None)
    friction = []
    arm = robot._arm.on
    for k in range(200):
        q = arm.setpoint[0].copy()
        q[0] += 0.5 / 125
        arm.advance(np.array([[q, [0.5, 0, 0, 0, 0, 0], np.zeros(6)]]))
        friction += [arm.friction[0]] if k > 150 else []
    robot.close()
    return abs(np.mean(friction))


def test_another_day_has_other_noise_of_the_same_size() -> None:
    first, again, other = rows(), rows(day=0), rows(day=1)
    assert np.array_equal(first["effort"], again["effort"])
    assert not np.array_equal(first["effort"], other["effort"])
    assert np.std(other["effort"]) == pytest.approx(np.std(first["effort"]), rel=0.1)


def test_a_warm_room_warms_the_joints() -> None:
    assert rows(room_c=31.0)["temperature"][0] == pytest.approx(31.0, abs=1.0)


def test_wear_is_more_friction_in_its_joint() -> None:
    worn = moved(wear=[1.15, 1, 1, 1, 1, 1])
    assert worn / moved() == pytest.approx(1.15, rel=0.01)
    assert moved(wear=[1, 1.15, 1, 1, 1, 1]) == pytest.approx(moved(), rel=0.01)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"wear": [1, 2]}, "wear"),
        ({"wear": [1, 1, 1, 1, 1, 0]}, "wear"),
        ({"wear": "much"}, "wear"),
        ({"day": -1}, "day"),
        ({"day": True}, "day"),
        ({"room_c": 99}, "room_c"),
    ],
)
def test_slips_are_told(given, words) -> None:
    with pytest.raises(SpecError, match=f"mock option {words} is"):
        MockRobot("aged", "ur5", **given)
