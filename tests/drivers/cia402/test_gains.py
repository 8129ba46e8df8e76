"""Gains of CST and CSV in the drives' units, checked in N·m and rad/s."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.arms import load_arm
from hil_drivers.cia402.commissioning import Drive
from hil_drivers.cia402.player import KV_PER_S, LOOP_RAD_S, gains_of
from hil_drivers.cia402.profile import AxisProfile, Scaling

ARM = load_arm("lab6")
AXIS = AxisProfile(1 << 20, 121.0, 2.5, 1.3)
TURNED = replace(AXIS, polarity=0xC0, velocity_unit="0.001 rpm")  # position counts backwards
AXES = [AXIS, TURNED, replace(AXIS, direction=-1), AXIS, AXIS, AXIS]
SCALING = Scaling(AXES)
DRIVES = [Drive({"max_torque": 1500}, axis) for axis in AXES]
GIVEN = [{"stiffness_nm_rad": 800.0, "damping_nms_rad": 60.0}] * 6


def test_an_error_of_position_gives_the_torque_of_the_spring_whatever_the_signs_are():
    gains = gains_of(GIVEN, DRIVES, ARM)
    error = SCALING.raw_position(0.25) - SCALING.raw_position(0.15)
    assert SCALING.torque(gains.kp * error) == pytest.approx(80.0, rel=1e-4)


def test_an_error_of_velocity_gives_the_torque_of_the_damper():
    gains = gains_of(GIVEN, DRIVES, ARM)
    torque = SCALING.torque(gains.kd * SCALING.raw_velocity(0.5))
    assert torque == pytest.approx(30.0, rel=1e-3)


def test_an_error_of_position_gives_a_velocity_that_closes_it():
    gains = gains_of(GIVEN, DRIVES, ARM)
    counts = gains.kv * (SCALING.raw_position(0.1) - SCALING.raw_position(0.0))
    assert SCALING.velocity(np.rint(counts)) == pytest.approx(0.1 * KV_PER_S, rel=1e-3)


def test_no_more_torque_is_commanded_than_drive_and_arm_allow():
    free = [Drive({}, axis) for axis in AXES]
    assert gains_of(GIVEN, DRIVES, ARM).limit[0] == pytest.approx(1500)
    arms = gains_of(GIVEN, free, ARM).limit
    assert np.array(arms) * abs(AXIS.nm_per_count) == pytest.approx(ARM.effort_max)


def test_by_default_the_loop_is_critically_damped_on_the_least_inertia():
    gains = gains_of([{}] * 6, DRIVES, ARM)
    inertia = 0.1 * ARM.effort_max[0] / ARM.qdd_max[0]
    stiffness = gains.kp[0] * AXIS.nm_per_count / AXIS.rad_per_increment
    damping = gains.kd[0] * AXIS.nm_per_count / AXIS.rad_s_per_count
    assert stiffness / inertia == pytest.approx(LOOP_RAD_S**2)
    assert damping / (2 * np.sqrt(stiffness * inertia)) == pytest.approx(1.0)
