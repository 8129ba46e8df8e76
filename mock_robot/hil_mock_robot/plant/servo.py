"""Joint servo of the mock: feed-forward from the manufacturer's published model, PD and integrator.

The servo does not know the true parameters, as in a real robot: its gains come from the nominal
model only.
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
"""Position error at which the torque limit is reached [rad]; with this error, light wrists are
stiff enough."""

DAMPING = 0.7
INTEGRAL_S = 0.8
REST_INTEGRAL_S = 0.2

REST_BAND_RAD = 5e-5
"""Position error at standstill below which the integrator does not act [rad]."""

WINDUP_SHARE = 0.3
"""Largest torque of the integrator, as a share of the torque limit."""

SIGN_RAD_S = 0.003
"""Width of the smooth sign in the friction feed-forward [rad/s]; the feed-forward fades at the
end of a motion."""

COMMANDS = 3
"""Number of rows of a set-point: position, velocity, acceleration."""

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
"""Parameters of one joint's servo (nominal values) and of its drive (`true_…`, true values)."""


def servo_laws(arm: ArmDescription, truth: Truth, nominal: Plant) -> StructArray:
    """Return records of `SERVO` (n,), with gains scaled by the nominal inertia of each joint."""
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
    """Return the mean diagonal (n,) of the nominal mass matrix over the arm's usual range."""
    rng = np.random.default_rng(0)
    poses = rng.uniform(arm.excite_min, arm.excite_max, size=(64, arm.n_joints))
    return np.asarray(np.mean([np.diag(nominal.mass_matrix(q)) for q in poses], axis=0))


@njit(**COMPILED)
def interpolate(before: FloatArray, after: FloatArray, share: float, period: float, j: int) -> Any:
    """Return position and velocity of a cubic between two set-points (3, n).

    Args:
        before: (3, n) set-point at the beginning.
        after: (3, n) set-point at the end.
        share: Elapsed share of the period, 0 to 1.
        period: Time between the set-points [s].
        j: Index of the joint.
    """
    q0, v0, q1, v1 = before[0, j], before[1, j] * period, after[0, j], after[1, j] * period
    step = q1 - q0
    quadratic = 3.0 * step - 2.0 * v0 - v1
    cubic = v0 + v1 - 2.0 * step
    q = q0 + share * (v0 + share * (quadratic + share * cubic))
    v = v0 + share * (2.0 * quadratic + 3.0 * share * cubic)
    return q, v / period


@njit(**COMPILED)
def feedforward_friction(law: Any, v: float, torque: float) -> float:
    """Return the controller's expected friction at commanded speed and joint torque [N·m]."""
    dry = law.coulomb + law.load_share * abs(torque)
    return float(dry * math.tanh(v / SIGN_RAD_S) + law.viscous * v)


@njit(**COMPILED)
def integrate_error(law: Any, integral: float, error: float, moving: bool, dt: float) -> float:
    """Return the torque of the integrator after one servo cycle [N·m].

    At standstill the integrator ignores small errors, as real controllers do to prevent limit
    cycles by stiction. A stuck joint therefore retains the friction force of its approach.
    """
    if moving:
        integral += law.integral * error * dt
    elif abs(error) > law.rest_band:
        integral += law.rest_integral * (error - math.copysign(law.rest_band, error)) * dt
    return float(min(law.windup, max(-law.windup, integral)))


@njit(**COMPILED)
def drive_torque(law: Any, current: float) -> float:
    """Return the motor torque at the joint for a current (eq. 16, static friction paper)."""
    square = law.true_square * abs(current) * current
    return float(square + law.true_gain * current + law.true_constant)
