"""What the compiled step works on: named tuples and records that numba knows by type."""

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
    """What acts on the arm from outside the experiment; all (n,) and settable between blocks.

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
