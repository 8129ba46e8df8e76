"""Robot models as documents: how a model was made comes back, through JSON."""

import json

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil.dynamics import RobotModel, load_model
from tests.support.dynamics_arms import motion, urdf, written

ROTORS = (0.75, 0.74, 0.62, 0.11, 0.12, 0.13)
WALL = (-9.81, 0.0, 0.3)
LOADS = (Payload(2.8, (0.03, -0.15, 0.06), (0.011, 0.014, 0.009, 0.001, -0.002, 0.0005)),
         Payload(0.5, (0.0, 0.0, 0.1)))  # fmt: skip


def through_json(robot):
    return RobotModel.from_dict(json.loads(json.dumps(robot.to_dict())))


def assert_same(again, robot):
    for sample in (motion(5), motion(5, seed=1)):
        ours, theirs = (each.inverse_dynamics(*sample) for each in (robot, again))
        np.testing.assert_array_equal(theirs, ours)
    np.testing.assert_array_equal(again.parameters(), robot.parameters())
    assert again.to_dict() == robot.to_dict()


@pytest.mark.parametrize("name", ["ur5", "lab6"])
def test_arm_comes_back_with_mounting_rotors_and_loads(name):
    robot = load_model(name, ROTORS, WALL)
    for load in LOADS:
        robot = robot.with_payload(load)
    assert robot.payloads == LOADS
    assert_same(through_json(robot), robot)


def test_urdf_comes_back_from_its_path_with_its_flange(tmp_path):
    file = written(tmp_path, urdf("ur5"))
    robot = RobotModel.from_urdf(file, ROTORS, WALL).with_payload(LOADS[0])
    document = robot.to_dict()
    assert (document["kind"], document["name"]) == ("urdf", str(file))
    assert_same(through_json(robot), robot)


def test_document_of_a_plain_arm_says_that_it_stands_upright():
    document = load_model("ur5").to_dict()
    assert document["gravity_m_s2"] == [0.0, 0.0, -9.81]
    assert document["rotor_inertia_kgm2"] == [0.0] * 6
    assert document["payloads"] == []


def test_unknown_arm_is_refused():
    with pytest.raises(SpecError, match="no built-in arm 'ur7'"):
        RobotModel.from_dict(load_model("ur5").to_dict() | {"name": "ur7"})


def test_arm_descriptions_are_parsed_once_and_cannot_be_written():
    arm = load_arm("ur5")
    assert load_arm("ur5") is arm
    for name in ("dh", "q_min", "mass", "com", "inertia", "drive_gains"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(arm, name)[0] = 0.0
