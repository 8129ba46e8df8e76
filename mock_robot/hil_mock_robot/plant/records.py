"""Records and named tuples that the compiled step works on, and constants of the plant.

Light to import: options and messages need the names, not MuJoCo and numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import FloatArray, SpecError, StructArray

SERVO_S = 1e-3
"""The servo's own cycle: the same whatever the substep, so that substeps can be compared."""

STATE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "integral", "current", "torque", "friction", "heat_j", "celsius", "overload_s",
            "feedforward_0", "feedforward_1",
        )
    ]
)  # fmt: skip
"""What one joint carries from step to step, beside MuJoCo's state and the slip elements."""

HEAT = np.dtype([(name, np.float64) for name in ("idle_k", "k_per_w", "copper", "tau_s")])
GRAVITY = 9.81

MOUNTS = {
    "table": (0.0, 0.0, -GRAVITY),
    "ceiling": (0.0, 0.0, GRAVITY),
    "wall": (-GRAVITY, 0.0, 0.0),
}
"""Gravity in the base frame [m/s²] by the name of the mount."""

SETTLING_S = 1.0
RUNAWAY, PROTECTIVE_STOP, EMERGENCY_STOP, WATCHDOG = 3, 4, 5, 6

FAULTS = {
    1: "protective stop: a joint is more than 0.2 rad away from its set-point",
    2: "protective stop: a joint is at its torque limit",
    RUNAWAY: "the simulated arm runs away",
    PROTECTIVE_STOP: "protective stop, injected",
    EMERGENCY_STOP: "emergency stop, injected",
    WATCHDOG: "stopped by the controller's watchdog: nobody read it while it moved",
}

FAULT_KINDS = {
    1: "tracking",
    2: "overload",
    RUNAWAY: "runaway",
    PROTECTIVE_STOP: "protective_stop",
    EMERGENCY_STOP: "emergency_stop",
    WATCHDOG: "watchdog",
}
"""One word for each fault, for the journal."""


class Native(NamedTuple):
    """Addresses of MuJoCo's functions, models and states."""

    step1: int
    step2: int
    inverse: int
    model: int
    data: int
    nominal_model: int
    nominal_data: int


class Views(NamedTuple):
    """Numpy views into MuJoCo's states, each (n,)."""

    q: FloatArray
    v: FloatArray
    a: FloatArray
    applied: FloatArray
    nominal_q: FloatArray
    nominal_v: FloatArray
    nominal_a: FloatArray
    nominal_torque: FloatArray


class Joints(NamedTuple):
    """Parameters and state of the joints.

    Attributes:
        laws, servos, heats, states: (n,) records of `LAW`, `SERVO`, `HEAT` and `STATE`.
        shares, stiffness, forces: (n, E) slip elements.
        rotors: (n,) reflected inertia [kg·m²].
    """

    laws: StructArray
    servos: StructArray
    heats: StructArray
    states: StructArray
    shares: FloatArray
    stiffness: FloatArray
    forces: FloatArray
    rotors: FloatArray


class Disturbances(NamedTuple):
    """Influences from outside the experiment; all (n,) and settable between blocks.

    Attributes:
        push: External joint torque [N·m].
        torque: Commanded joint torque [N·m] in place of the servo's, NaN for position control.
        wear: Factor on all friction, 1 for a new joint.
    """

    push: FloatArray
    torque: FloatArray
    wear: FloatArray


class Timing(NamedTuple):
    """How a sample is divided.

    Attributes:
        substeps: Integration steps per sample.
        per_servo: Integration steps per servo cycle.
        dt: Integration step [s].
    """

    substeps: int
    per_servo: int
    dt: float


class Room(NamedTuple):
    """Temperature of the surroundings: mean [°C], swing [K], angular frequency and phase."""

    mean: float
    swing: float
    omega: float
    phase: float


def timing_of(rate_hz: float, substep_hz: float) -> Timing:
    """Whole numbers of substeps per sample and per servo cycle.

    Raises:
        SpecError: The rates do not divide each other.
    """
    substeps, per_servo = substep_hz / rate_hz, substep_hz * SERVO_S
    whole = all(n >= 1 and abs(n - round(n)) < 1e-9 for n in (substeps, per_servo))
    if not whole or round(substeps) % round(per_servo):
        raise SpecError(
            f"substep_hz {substep_hz:g} does not fit rate_hz {rate_hz:g}",
            hint="substep_hz must be a multiple of 1000, and rate_hz a divisor of 1000",
        )
    return Timing(round(substeps), round(per_servo), 1.0 / substep_hz)
