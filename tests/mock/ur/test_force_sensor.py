"""The force and torque sensor of an e-Series arm, against forces worked out here."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.arms.payload import Payload
from hil_mock_robot.ur import kinematics
from tests.support.ur_machine import machine_of, movej, pass_time

BENT = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.1])
NO_TOOL = np.zeros(6)


def turn_of(machine):
    """(3, 3) rotation of the flange."""
    pose = kinematics.pose_of(machine.body.arm, machine.reading.q, NO_TOOL)
    return Rotation.from_rotvec(pose[3:]).as_matrix()


def test_it_carries_what_really_hangs_there_whatever_is_declared():
    machine, com = machine_of("ur5e"), (0.1, 0.0, 0.05)
    machine.body.mount(Payload(2.0, com))
    pass_time(machine, 0.1)
    force = turn_of(machine).T @ [0.0, 0.0, -2.0 * 9.81]
    carried = [*force, *np.cross(com, force)]
    assert machine.outputs["ft_raw_wrench"] == pytest.approx(carried, abs=0.05)


@pytest.mark.thorough
def test_it_feels_pushes_in_its_own_axes():
    machine = machine_of("ur5e")
    machine.move(movej(BENT, 2.0, 10.0, machine.tick_s))
    pass_time(machine, 3.0)
    before = np.array(machine.outputs["ft_raw_wrench"])
    J = np.asarray(kinematics.jacobian(machine.body.arm, BENT, NO_TOOL))
    wrench = np.array([5.0, -3.0, 8.0, 0.2, 0.1, -0.3])
    machine.body.push(J.T @ wrench)
    pass_time(machine, 0.002)
    R = turn_of(machine).T
    felt = np.array(machine.outputs["ft_raw_wrench"]) - before
    assert felt == pytest.approx([*R @ wrench[:3], *R @ wrench[3:]], abs=0.5)


def test_cb3_has_none():
    assert "ft_raw_wrench" not in machine_of("ur5").outputs
