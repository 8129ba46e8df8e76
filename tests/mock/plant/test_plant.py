"""The mock's rigid body against Pinocchio, built here from the same truth by other means."""

import numpy as np
import pinocchio as pin
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil_mock_robot.embedded.options import gravity_of
from hil_mock_robot.plant.model import build_plant
from hil_mock_robot.plant.records import MOUNTS
from hil_mock_robot.plant.truth import draw_truth

LOAD = Payload(2.5, (0.02, -0.01, 0.06), (0.01, 0.012, 0.008, 0.001, -0.0005, 0.0002))


def matrix(six):
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pinocchio_arm(arm, truth, payload, gravity):
    model, joint, place = pin.Model(), 0, pin.SE3.Identity()
    for row, link in zip(arm.dh, truth.links, strict=True):
        place = place * pin.SE3(pin.utils.rotate("z", row[3]), np.zeros(3))
        joint = model.addJoint(joint, pin.JointModelRZ(), place, f"joint{joint}")
        place = pin.SE3(pin.utils.rotate("x", row[1]), np.array([row[0], 0, row[2]]))
        body = pin.Inertia(link.mass_kg, np.array(link.com_m), matrix(link.inertia_kgm2))
        model.appendBodyToJoint(joint, body, place)
    load = pin.Inertia(payload.mass, np.array(payload.com), matrix(payload.inertia))
    model.appendBodyToJoint(joint, load, place)
    model.armature = np.array([j.drive.rotor_kgm2 for j in truth.joints])
    model.gravity.linear = np.array(gravity)
    return model


@pytest.fixture(params=["ur5", "lab6"])
def pair(request):
    arm, truth = load_arm(request.param), draw_truth(request.param, 11)
    rotors = [joint.drive.rotor_kgm2 for joint in truth.joints]

    def build(payload, gravity):
        plant = build_plant(arm.dh, truth.links, rotors, payload, gravity, 1e-3)
        model = pinocchio_arm(arm, truth, payload, gravity)
        return plant, model, model.createData()

    return build


@pytest.mark.parametrize("mount", sorted(MOUNTS))
def test_joint_torques_of_a_motion_agree(pair, mount):
    plant, model, data = pair(LOAD, MOUNTS[mount])
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v, a = rng.uniform(-2, 2, (3, 6))
        expected = pin.rnea(model, data, q, v, a)
        assert plant.inverse(q, v, a) == pytest.approx(expected, abs=1e-6)


def test_mass_matrix_agrees_rotors_included(pair):
    plant, model, data = pair(Payload(), MOUNTS["table"])
    q = np.array([0.3, -1.1, 0.8, -0.4, 1.2, 0.5])
    inertia = pin.crba(model, data, q)
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    assert plant.mass_matrix(q) == pytest.approx(inertia, abs=1e-7)


def test_point_mass_without_inertia_can_be_mounted(pair):
    plant, model, data = pair(Payload(1.0, (0, 0, 0.1)), MOUNTS["table"])
    q = np.full(6, 0.5)
    zero = np.zeros(6)
    expected = pin.computeGeneralizedGravity(model, data, q)
    assert plant.inverse(q, zero, zero) == pytest.approx(expected, abs=1e-6)


def test_gravity_can_be_given_and_an_unknown_mount_is_refused():
    assert gravity_of([0, 1, -9]) == (0.0, 1.0, -9.0)
    with pytest.raises(SpecError, match="mount 'moon'"):
        gravity_of("moon")
