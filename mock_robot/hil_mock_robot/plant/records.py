"""Records and named tuples of the compiled step, and constants of the plant.

This module imports neither MuJoCo nor numba, so that options and messages can use it at low cost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import FloatArray, SpecError, StructArray

SERVO_S = 1e-3
"""Time between two servo cycles [s], independent of the integration step, so that results for
different steps can be compared."""

STATE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "integral", "current", "torque", "friction", "heat_j", "celsius", "overload_s",
            "feedforward_0", "feedforward_1",
        )
    ]
)  # fmt: skip
"""State of one joint, in addition to MuJoCo's state and the slip elements."""

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
    RUNAWAY: "the simulated motion has become unstable",
    PROTECTIVE_STOP: "protective stop, injected",
    EMERGENCY_STOP: "emergency stop, injected",
    WATCHDOG: "stopped by the controller's watchdog: no client read the state during a motion",
}

FAULT_KINDS = {
    1: "tracking",
    2: "overload",
    RUNAWAY: "runaway",
    PROTECTIVE_STOP: "protective_stop",
    EMERGENCY_STOP: "emergency_stop",
    WATCHDOG: "watchdog",
}
"""Map from fault code to a short name, for the journal."""


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
    """Numpy views of MuJoCo's states, each (n,)."""

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
        shares, stiffness, forces: (n, E) values of the slip elements.
        rotors: (n,) reflected rotor inertia [kg·m²].
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
    """External influences, all (n,); they may change between blocks.

    Attributes:
        push: External joint torque [N·m].
        torque: Commanded joint torque instead of the servo's torque [N·m]; NaN for position
            control.
        wear: Factor on all friction, 1 for a new joint.
    """

    push: FloatArray
    torque: FloatArray
    wear: FloatArray


class Timing(NamedTuple):
    """Division of a sample into integration steps.

    Attributes:
        substeps: Number of integration steps per sample.
        per_servo: Number of integration steps per servo cycle.
        dt: Integration step [s].
    """

    substeps: int
    per_servo: int
    dt: float


class Room(NamedTuple):
    """Room temperature: mean [°C], amplitude [K], angular frequency and phase of its drift."""

    mean: float
    swing: float
    omega: float
    phase: float


def timing_of(rate_hz: float, substep_hz: float) -> Timing:
    """Return the whole numbers of integration steps per sample and per servo cycle.

    Raises:
        SpecError: The rates are not multiples of each other.
    """
    substeps, per_servo = substep_hz / rate_hz, substep_hz * SERVO_S
    whole = all(n >= 1 and abs(n - round(n)) < 1e-9 for n in (substeps, per_servo))
    if not whole or round(substeps) % round(per_servo):
        raise SpecError(
            f"substep_hz {substep_hz:g} does not fit rate_hz {rate_hz:g}",
            hint="substep_hz must be a multiple of 1000, and rate_hz a divisor of 1000",
        )
    return Timing(round(substeps), round(per_servo), 1.0 / substep_hz)
