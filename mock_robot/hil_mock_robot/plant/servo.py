"""The mock's joint servo: feed-forward from what the maker publishes, PD and an integrator.

Its gains come from the nominal arm only, as on a real robot: it does not know its own truth.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, StructArray
from hil_mock_robot.plant.friction import COMPILED
from hil_mock_robot.plant.model import Plant
from hil_mock_robot.plant.native import require_libraries
from hil_mock_robot.plant.truth import Truth

require_libraries()

from numba import njit  # noqa: E402

BANDWIDTH_RAD_S = 60.0

FULL_RAD = 0.035
"""A position error that takes the whole torque limit; it makes light wrists stiff enough."""

DAMPING = 0.7
INTEGRAL_S = 0.8
REST_INTEGRAL_S = 0.2

REST_BAND_RAD = 5e-5
"""Position errors at rest that the integrator leaves alone."""

WINDUP_SHARE = 0.3
"""The integrator may reach this share of the torque limit."""

SIGN_RAD_S = 0.003
"""Width of the smooth sign in the friction feed-forward: it lets go at the very end of a motion."""

COMMANDS = 3
"""Rows of a set-point: position, velocity, acceleration."""

SERVO = np.dtype(
    [
        (name, np.float64)
        for name in (
            "stiffness", "damping", "integral", "rest_integral", "rest_band", "windup",
            "coulomb", "load_share", "viscous", "gain", "limit",
            "true_gain", "true_square", "true_constant",
        )
    ]
)  # fmt: skip
"""One joint's servo (what it believes) and drive (`true_…`, what it gets)."""


def servo_laws(arm: ArmDescription, truth: Truth, nominal: Plant) -> StructArray:
    """(n,) records of `SERVO`, gains scaled by the nominal inertia each joint carries."""
    inertia = _typical_inertia(arm, nominal)
    records = np.zeros(arm.n_joints, dtype=SERVO)
    records["stiffness"] = np.maximum(inertia * BANDWIDTH_RAD_S**2, arm.effort_max / FULL_RAD)
    records["damping"] = 2 * DAMPING * np.sqrt(records["stiffness"] * inertia)
    records["integral"] = records["stiffness"] / INTEGRAL_S
    records["rest_integral"] = records["stiffness"] / REST_INTEGRAL_S
    records["rest_band"] = REST_BAND_RAD
    records["windup"] = WINDUP_SHARE * arm.effort_max
    records["gain"] = arm.drive_gains
    records["limit"] = arm.effort_max
    for record, joint in zip(records, truth.joints, strict=True):
        record["coulomb"] = joint.feedforward_coulomb_nm
        record["load_share"] = joint.feedforward_load_share
        record["viscous"] = joint.feedforward_viscous_nm_s
        record["true_gain"] = joint.drive.gain_nm_a
        record["true_square"] = joint.drive.square_nm_a2
        record["true_constant"] = joint.drive.constant_nm
    return records


def _typical_inertia(arm: ArmDescription, nominal: Plant) -> FloatArray:
    """(n,) mean diagonal of the nominal mass matrix over the arm's usual range."""
    rng = np.random.default_rng(0)
    poses = rng.uniform(arm.excite_min, arm.excite_max, size=(64, arm.n_joints))
    return np.asarray(np.mean([np.diag(nominal.mass_matrix(q)) for q in poses], axis=0))


@njit(**COMPILED)
def interpolate(before: FloatArray, after: FloatArray, share: float, period: float, j: int) -> Any:
    """Cubic between two set-points (3, n) a `period` apart; returns position and velocity."""
    q0, v0, q1, v1 = before[0, j], before[1, j] * period, after[0, j], after[1, j] * period
    step = q1 - q0
    quadratic = 3.0 * step - 2.0 * v0 - v1
    cubic = v0 + v1 - 2.0 * step
    q = q0 + share * (v0 + share * (quadratic + share * cubic))
    v = v0 + share * (2.0 * quadratic + 3.0 * share * cubic)
    return q, v / period


@njit(**COMPILED)
def feedforward_friction(law: Any, v: float, torque: float) -> float:
    """The friction the controller expects at commanded speed `v` and joint torque [N·m]."""
    dry = law.coulomb + law.load_share * abs(torque)
    return float(dry * math.tanh(v / SIGN_RAD_S) + law.viscous * v)


@njit(**COMPILED)
def integrate_error(law: Any, integral: float, error: float, moving: bool, dt: float) -> float:
    """The integrator's torque [N·m] after one servo cycle.

    At rest it leaves small errors alone, as controllers do to keep stiction from making them
    hunt. That is why a stuck joint keeps the friction its approach left it with.
    """
    if moving:
        integral += law.integral * error * dt
    elif abs(error) > law.rest_band:
        integral += law.rest_integral * (error - math.copysign(law.rest_band, error)) * dt
    return float(min(law.windup, max(-law.windup, integral)))


@njit(**COMPILED)
def drive_torque(law: Any, current: float) -> float:
    """Motor torque at the joint for a current: eq. 16 of the static friction paper."""
    square = law.true_square * abs(current) * current
    return float(square + law.true_gain * current + law.true_constant)
