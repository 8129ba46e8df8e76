"""The object dictionary of one drive: its registers, and the same for CANopen tools.

The tables are in `communication_objects` and `drive_objects`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

import numpy as np

from hil.arms import ArmDescription
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.communication_objects import COMMUNICATION
from hil_mock_robot.cia402.contracts import Registers, key
from hil_mock_robot.cia402.drive_objects import DRIVE, VENDOR
from hil_mock_robot.cia402.objects import CODES, Group, Object, raw_real

TABLE: tuple[Object | Group, ...] = COMMUNICATION + VENDOR + DRIVE
ENCODER_INCREMENTS = 1 << 20
"""Per motor revolution."""

PEAK_TO_RATED = 2.1
"""Joint torque limit of the arm to the motor's rated torque at the joint."""

FOLLOWING_ERROR_RAD = np.radians(5.0)
POSITION_WINDOW_RAD = np.radians(0.02)
PROFILE_SHARE = 0.25
"""Of the joint's speed and acceleration: what point-to-point moves begin with."""

SERIALS = 402_000
"""Serial numbers count on from here."""


def variables() -> Iterator[Object]:
    """All variables, members of groups among them."""
    for part in TABLE:
        yield from part.members if isinstance(part, Group) else (part,)


@cache
def by_key() -> Mapping[int, Object]:
    """All variables by their key in `Registers`."""
    return {entry.key: entry for entry in variables()}


@cache
def indices() -> frozenset[int]:
    """All indices of the dictionary."""
    return frozenset(part.index for part in TABLE)


def registers_of(arm: ArmDescription, joint: int) -> Registers:
    """All objects of the drive of a joint (from 0) as they are after power-on.

    Drive of the joint: 2^20 increments a motor revolution (608Fh), gear in 6091h, rated torque =
    effort_max / gear / 2.1 [mN·m], rated current = rated torque / (drive_gain / gear) [mA], limits
    607Dh from q_min and q_max, velocity in increments/s. COB-IDs lack the node's id: the node
    adds it.
    """
    registers = {
        entry.key: raw_of(entry, entry.default) for entry in variables() if entry.type in CODES
    }
    return registers | _axis(arm, joint)


def raw_of(entry: Object, value: object) -> int:
    """What `Registers` keeps for a number."""
    assert isinstance(value, int | float)
    return raw_real(value) if entry.type == "f32" else int(value)


def increments_per_rad(arm: ArmDescription, joint: int) -> float:
    """Encoder increments of the motor per radian of the joint."""
    return float(ENCODER_INCREMENTS * arm.gear_ratio[joint] / (2 * np.pi))


def _axis(arm: ArmDescription, joint: int) -> Registers:
    """What depends on the joint."""
    scale = increments_per_rad(arm, joint)
    gear = float(arm.gear_ratio[joint])
    rated_nm = float(arm.effort_max[joint]) / gear / PEAK_TO_RATED
    rated_a = rated_nm / (float(arm.drive_gains[joint]) / gear)
    speed, acceleration = float(arm.qd_max[joint]), round(arm.qdd_max[joint] * scale)
    return {
        key(0x1018, 4): SERIALS + joint + 1,
        keys.FOLLOWING_ERROR_WINDOW: round(FOLLOWING_ERROR_RAD * scale),
        keys.POSITION_WINDOW: round(POSITION_WINDOW_RAD * scale),
        keys.RATED_CURRENT: round(1000 * rated_a),
        keys.RATED_TORQUE: round(1000 * rated_nm),
        keys.POSITION_LIMIT_MIN: int(np.ceil(arm.q_min[joint] * scale)),
        keys.POSITION_LIMIT_MAX: int(np.floor(arm.q_max[joint] * scale)),
        keys.MAX_PROFILE_VELOCITY: round(speed * scale),
        keys.MAX_MOTOR_SPEED: round(speed * gear * 60 / (2 * np.pi)),
        keys.PROFILE_VELOCITY: round(PROFILE_SHARE * speed * scale),
        keys.PROFILE_ACCELERATION: round(PROFILE_SHARE * acceleration),
        keys.PROFILE_DECELERATION: round(PROFILE_SHARE * acceleration),
        keys.QUICK_STOP_DECELERATION: acceleration,
        keys.GEAR_MOTOR: round(gear),
        key(0x6092, 1): ENCODER_INCREMENTS * round(gear),
        keys.HOMING_ACCELERATION: round(PROFILE_SHARE * acceleration),
        keys.MAX_ACCELERATION: acceleration,
        keys.MAX_DECELERATION: acceleration,
    }
