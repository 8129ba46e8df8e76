"""Raw integers of a drive ↔ SI, against numbers worked out by hand, and error codes in words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import canopen
import numpy as np
import pytest

from hil.core.errors import SpecError
from hil_drivers.cia402.bus import Emergency
from hil_drivers.cia402.objects import (
    ABORTS,
    ERROR_RANGES,
    ERRORS,
    abort_text,
    error_text,
    register_text,
)
from hil_drivers.cia402.profile import PROFILES, AxisProfile, Scaling, axis_profile

# 1.27 N·m rated through a gear of 100: 6077h in ‰ is 0.127 N·m at the joint per count.
MOTOR = AxisProfile(
    encoder_increments=1 << 20, gear_ratio=100.0, rated_current_a=2.5, rated_torque_nm=1.27
)
TURN_COUNTS = 100 * (1 << 20)
"""Increments of one joint revolution."""


class One:
    """A single axis, number by number."""

    def __init__(self, axis: AxisProfile) -> None:
        self._scaling = Scaling([axis])

    def __getattr__(self, name: str) -> Any:
        return lambda value: getattr(self._scaling, name)([value])[0]


def test_a_quarter_turn_of_the_joint_is_a_quarter_of_gear_times_encoder():
    assert One(MOTOR).position(TURN_COUNTS // 4) == pytest.approx(math.pi / 2)
    assert One(MOTOR).raw_position(-math.pi) == -TURN_COUNTS // 2


def test_several_motor_revolutions_per_encoder_increments_are_divided_out():
    axis = replace(MOTOR, encoder_increments=3 << 20, encoder_revolutions=3)
    assert One(axis).position(TURN_COUNTS) == pytest.approx(2 * math.pi)


def test_torque_and_current_are_per_mille_of_the_rated_ones():
    assert One(MOTOR).torque(1000) == pytest.approx(127.0)
    assert One(MOTOR).torque(-1) == pytest.approx(-0.127)
    assert One(MOTOR).current(400) == pytest.approx(1.0)
    assert One(MOTOR).raw_torque(63.5) == 500


def test_the_resolution_of_torque_is_one_count_at_the_joint():
    scaling = Scaling([MOTOR, replace(MOTOR, direction=-1, gear_ratio=50.0)])
    assert scaling.torque_resolution == pytest.approx([0.127, 0.0635])
    assert scaling.drive_gains == pytest.approx((50.8, 25.4))  # 1.27 N·m / 2.5 A × gear


@pytest.mark.parametrize(
    ("unit", "counts"),
    [
        ("increments/s", 1 << 20),
        ("rpm", 60),
        ("0.001 rpm", 60_000),
        ("0.0001 rpm", 600_000),
        ("beckhoff", 268_435.456),
    ],
)
def test_one_motor_revolution_per_second_in_every_velocity_unit(unit, counts):
    axis = replace(MOTOR, velocity_unit=unit)
    joint = 2 * math.pi / 100  # rad/s behind the gear
    assert One(axis).velocity(round(counts)) == pytest.approx(joint, rel=1e-5)
    assert One(axis).raw_velocity(joint) == round(counts)


# EL7211 with a motor of 2.7 A (peak) and 0.21 N·m/A: rated torque 2.7/√2 × 0.21 = 0.400 928 …
EL72XX = {
    "encoder_increments": 1 << 20, "gear_ratio": 80.0, "rated_current_a": 2.7,
    "torque_constant_nm_a": 0.21,
}  # fmt: skip


def test_el72xx_torque_is_rated_current_by_root_two_times_torque_constant():
    axis = axis_profile("el72xx", EL72XX, {})
    assert One(axis).torque(1000) == pytest.approx(0.4009275 * 80, rel=1e-5)


def test_el72xx_told_otherwise_by_2002h_54_leaves_root_two_out():
    for said in ({"rated_current_is": "rms"}, {}):
        given = EL72XX if said else {**EL72XX, "rated_current_is": "rms"}
        assert One(axis_profile("el72xx", given, said)).torque(1000) == pytest.approx(0.567 * 80)


def test_by_6076h_an_el72xx_would_be_wrong_by_root_two():
    right = axis_profile("el72xx", EL72XX, {"rated_torque_nm": 0.567})
    naive = axis_profile("generic", EL72XX, {"rated_torque_nm": 0.567})
    assert One(naive).torque(700) / One(right).torque(700) == pytest.approx(2**0.5)


def test_the_gain_of_an_el72xx_belongs_to_the_current_that_is_recorded():
    axis = axis_profile("el72xx", EL72XX, {})
    assert One(axis).current(1000) * axis.drive_gain == pytest.approx(One(axis).torque(1000))


@pytest.mark.parametrize(
    ("polarity", "direction", "signs"),
    [
        (0x00, 1, (1, 1, 1)),
        (0x80, 1, (-1, 1, 1)),
        (0x40, 1, (1, -1, 1)),
        (0xC0, -1, (1, 1, -1)),
        (0xE0, 1, (-1, -1, -1)),
    ],
)
def test_polarity_bits_turn_position_and_velocity_and_direction_turns_all(
    polarity, direction, signs
):
    axis = replace(MOTOR, polarity=polarity, direction=direction)
    told = One(axis).position(1000), One(axis).velocity(1000), One(axis).torque(1000)
    assert tuple(np.sign(told)) == signs


def test_an_unsigned_counter_runs_over_in_the_middle_of_the_range_without_a_jump():
    # The joint's zero is where the counter reads 2^32 − 5: five counts on, it starts anew.
    axis = replace(MOTOR, position_unsigned=True)
    axis = replace(axis, offset_rad=-((1 << 32) - 5) * axis.rad_per_increment)
    raw = [((1 << 32) - 10 + k) % (1 << 32) for k in range(20)]
    counts = np.array([One(axis).position(each) for each in raw]) / axis.rad_per_increment
    assert counts == pytest.approx(np.arange(-5, 15), abs=1e-3)


def test_32_bits_mean_the_same_read_with_and_without_sign():
    axis = replace(MOTOR, position_unsigned=True, centre_rad=0.3)
    for raw in (0, 1, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF):
        signed = raw - (1 << 32) if raw >> 31 else raw
        assert One(axis).position(raw) == One(axis).position(signed)


def test_a_wrapped_position_is_the_one_nearest_to_the_middle_of_the_range():
    turns = 2 * math.pi * 2**32 / TURN_COUNTS  # the counter runs over every 40.96 revolutions
    for centre in (0.0, turns, -3 * turns):
        axis = replace(MOTOR, centre_rad=centre)
        assert One(axis).position(12345) == pytest.approx(centre + 12345 * axis.rad_per_increment)


@pytest.mark.parametrize("unsigned", [False, True])
def test_targets_and_measured_positions_agree_over_the_whole_range(unsigned):
    axis = replace(MOTOR, position_unsigned=unsigned, offset_rad=2.0, centre_rad=1.0, direction=-1)
    for q in np.linspace(-5.0, 7.0, 41):
        assert One(axis).position(One(axis).raw_position(q)) == pytest.approx(q, abs=1e-7)


def test_targets_beyond_32_bits_stop_at_the_end_or_wrap_as_the_counter_does():
    far = 2**31 * MOTOR.rad_per_increment
    assert One(MOTOR).raw_position(2 * far) == 2**31 - 1
    assert One(MOTOR).raw_position(-2 * far) == -(2**31)
    wrapping = replace(MOTOR, position_unsigned=True)
    assert One(wrapping).raw_position(1.5 * far) == -(2**30)


def test_torques_and_velocities_beyond_their_types_stop_at_the_ends():
    assert One(MOTOR).raw_torque(1e6) == 32767
    assert One(MOTOR).raw_torque(-1e6) == -32768
    assert One(MOTOR).raw_velocity(-1e6) == -(2**31)


def mixed_axes() -> list[AxisProfile]:
    return [
        replace(MOTOR, offset_rad=0.7),
        replace(MOTOR, polarity=0xC0, gear_ratio=51.0, velocity_unit="0.001 rpm"),
        replace(axis_profile("el72xx", EL72XX, {}), offset_rad=-300.0, direction=-1),
    ]


def test_positions_of_exact_counts_come_back_exactly():
    for axis in mixed_axes():
        centre = axis.centre_counts
        for raw in (centre - 10**6, centre, centre + 1, centre + 10**8):
            wire = (raw + 2**31) % 2**32 - 2**31
            assert One(axis).raw_position(One(axis).position(wire)) == wire


def test_what_neither_station_nor_drive_says_is_asked_for_by_name():
    with pytest.raises(SpecError, match="defines rated_current_a, torque_constant_nm_a") as caught:
        axis_profile("el72xx", {"gear_ratio": 80.0}, {"encoder_increments": 1 << 20})
    assert "axes.rated_current_a" in caught.value.hint


def test_the_station_wins_over_the_drive_and_the_drive_over_its_device_profile():
    axis = axis_profile("el72xx", {**EL72XX, "velocity_unit": "rpm"}, {"position_unsigned": False})
    assert (axis.velocity_unit, axis.position_unsigned) == ("rpm", False)
    assert PROFILES["el72xx"]["position_unsigned"]


# Error codes, error registers and SDO aborts in words.


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8611, "following error"),
        (0x8130, "heartbeat of the master lost"),
        (0x2312, "over-current at the output"),  # by FFF0h
        (0x23F0, "current at the output"),  # by FF00h
        (0x7777, "additional modules"),  # by F000h
        (0xFF42, "vendor's own error"),
        (0x0000, "no error"),
        (0xA000, "unknown error"),
    ],
)
def test_a_code_is_told_by_its_own_text_or_by_the_narrowest_range(code, text):
    assert error_text(code) == f"{text} ({code:04X}h)"


def test_ranges_are_asked_from_narrow_to_wide():
    widths = [mask.bit_count() for mask, _, _ in ERROR_RANGES]
    assert widths == sorted(widths, reverse=True)
    assert all(kept & mask == kept for mask, kept, _ in ERROR_RANGES)


@pytest.mark.parametrize("code", sorted(ERRORS))
def test_every_text_is_found_by_its_code(code):
    assert error_text(code).startswith(ERRORS[code])


def test_the_register_is_told_bit_by_bit():
    assert register_text(0x21) == "generic, device profile"
    assert register_text(0x00) == ""


def test_an_emergency_says_code_register_and_the_makers_data():
    emergency = Emergency(2, 0x8611, 0x21, b"\x01\x00\x00\x00\xff")
    assert str(emergency) == (
        "following error (8611h); error register: generic, device profile, data 01 00 00 00 ff"
    )
    assert str(Emergency(2, 0x3220, 0, bytes(5))) == "DC link under-voltage (3220h)"
    assert str(Emergency(2, 0, 0, bytes(5))) == "errors reset (0000h)"


def test_abort_codes_are_told_with_the_number_as_manuals_write_it():
    assert abort_text(0x06040041) == "cannot be mapped into a PDO (abort 0604 0041h)"
    assert abort_text(0x0BAD0001) == "abort 0BAD 0001h"


def test_every_abort_that_canopen_knows_has_a_text_of_ours():
    assert set(canopen.SdoAbortedError.CODES) <= set(ABORTS)
