"""The arm against a mock UR controller: same client library, same sockets, same answers."""

import pytest
from cell_client.arm import Arm, ProtectiveStop

BESIDE = [0.4, -1.4, 0.3, -1.5, 0.0, 0.2]


def test_the_arm_gets_where_it_was_told(ur_controller):
    with Arm(ur_controller.host) as arm:
        arm.move(BESIDE)
        assert arm.joints() == pytest.approx(BESIDE, abs=1e-3)


@pytest.mark.ur_controller("ur5e", speed=5)
def test_it_goes_on_after_a_protective_stop(ur_controller):
    ur_controller.fault("protective_stop", motion=1, after_s=0.3)
    with Arm(ur_controller.host) as arm:
        with pytest.raises(ProtectiveStop):
            arm.move(BESIDE)
        arm.recover()
        arm.move(BESIDE)
        assert arm.joints() == pytest.approx(BESIDE, abs=1e-3)
    assert len(ur_controller.journal("protective_stop")) == 1
