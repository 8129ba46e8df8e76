"""What the robot state says about the arm itself, which does not change."""

from __future__ import annotations

import struct
from functools import cache

from hil.arms import ArmDescription
from hil_mock_robot.ur.series import Series

UNCALIBRATED = 0xFFFFFFFF
DEFAULTS = (1.0472, 1.3963, 0.25, 1.2, 0.25)
"""Joint speed [rad/s], joint acceleration, tool speed [m/s], tool acceleration, radius [m]."""

ROBOT_TYPES = {"ur5": 1, "ur10": 2, "ur3": 3}
BOARD_E, BOX_E, SUBTYPE_E = 6, 4, 3
BOARD_CB3, BOX_CB3, SUBTYPE_CB3 = 5, 2, 1


@cache
def kinematics(arm: ArmDescription) -> bytes:
    """Sub-package 5: DH parameters by which the controller computes, here the published ones."""
    a, alpha, d, theta = arm.dh.T.tolist()
    return struct.pack(">6I24dI", *(UNCALIBRATED,) * 6, *theta, *a, *d, *alpha, 0)


@cache
def configuration(arm: ArmDescription, series: Series) -> bytes:
    """Sub-package 6: limits, defaults, DH parameters, what hardware it is."""
    a, alpha, d, theta = arm.dh.T.tolist()
    ranges = [each for pair in zip(arm.q_min, arm.q_max, strict=True) for each in pair]
    motion = [each for pair in zip(arm.qd_max, arm.qdd_max, strict=True) for each in pair]
    numbers = struct.pack(">53d", *ranges, *motion, *DEFAULTS, *a, *d, *alpha, *theta)
    kind = ROBOT_TYPES[arm.name.removesuffix("e")]
    if series.is_e:
        return numbers + struct.pack(">4i", BOARD_E, BOX_E, kind, SUBTYPE_E)
    return numbers + struct.pack(">4i", BOARD_CB3, BOX_CB3, kind, SUBTYPE_CB3)
