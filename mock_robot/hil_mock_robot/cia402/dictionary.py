"""The object dictionary of one drive, its registers, its EDS."""

from __future__ import annotations

from hil.arms import ArmDescription
from hil_mock_robot.cia402.contracts import Registers


def registers_of(arm: ArmDescription, joint: int) -> Registers:
    """All objects of the drive of a joint (from 0) as they are after power-on.

    Drive of the joint: 2^20 increments a motor revolution (608Fh), gear in 6091h, rated torque =
    effort_max / gear / 2.1 [mN·m], rated current = rated torque / (drive_gain / gear) [mA], limits
    607Dh from q_min and q_max, velocity in increments/s.
    """
    raise NotImplementedError
