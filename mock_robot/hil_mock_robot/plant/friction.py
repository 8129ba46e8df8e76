"""Friction law of one joint, compiled.

Generalised Maxwell-slip model (Al-Bender, Lampaert & Swevers, 2005): parallel springs, each with a
share of the friction limit. The force of a spring follows the displacement while the spring sticks;
the spring slips when its force reaches its share of the friction limit. The springs are the memory
of the model. The force depends on the position at which the joint reversed, a stuck joint retains
its force, and at standstill the forces slowly relax.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hil.core import FloatArray, StructArray
from hil_mock_robot.plant.native import require_libraries
from hil_mock_robot.plant.truth import JointTruth, Truth

require_libraries()

from numba import njit  # noqa: E402

COMPILED: dict[str, Any] = {"nogil": True, "fastmath": False}
"""Compiler options of all functions of the compiled step; without fastmath, results are
reproducible.

numba caches only the entry point of the compiled step, because numba detects changes only in
the file of the entry point.
"""

COLD_C, STRIBECK_GONE_C = 20.0, 50.0
"""Temperatures [°C] below which the Stribeck peak is fully present (`COLD_C`) and above which
the peak has vanished (`STRIBECK_GONE_C`)."""

VISCOUS_KNEE_RAD_S = 2e-3
"""Speed [rad/s] below which |v|^a is replaced by a linear function, because the slope of |v|^a
at 0 would be infinite."""

CREEP_RAD_S = 2e-3
"""Approximate joint speed above which the slip elements do not relax [rad/s]."""

STRIBECK_REACH = 8.0
"""Speed, in multiples of the Stribeck velocity, above which the Stribeck peak is below 0.04 %
and is not computed."""

LEAST_WARM = 0.3
"""Minimum of the linear temperature factor; this minimum is reached only far outside the
temperature range of a joint."""

LAW = np.dtype(
    [
        (name, np.float64)
        for name in (
            "coulomb", "stribeck", "stribeck_speed", "stribeck_shape", "viscous", "viscous_power",
            "load_share", "asymmetry", "offset", "slip_follow", "creep_s", "creep_floor", "smooth",
            "coulomb_per_k", "viscous_per_k", "reference_c",
            "ripple", "ripple_per_turn", "ripple_phase",
        )
    ]
)  # fmt: skip
"""Parameters of the friction law of one joint, in SI units and °C."""


def friction_laws(truth: Truth, dt: float) -> StructArray:
    """Return records of `LAW` (n,) for steps of `dt` [s]."""
    return np.array([_law_of(joint, truth.reference_c, dt) for joint in truth.joints], dtype=LAW)


def _law_of(joint: JointTruth, reference_c: float, dt: float) -> tuple[float, ...]:
    f, t, d = joint.friction, joint.thermal, joint.drive
    follow = 1.0 - math.exp(-dt / f.slip_s) if f.elements else 1.0
    return (
        f.coulomb_nm, f.stribeck_nm, f.stribeck_rad_s, f.stribeck_shape, f.viscous_nm,
        f.viscous_power, f.load_share, f.asymmetry, f.offset_nm, follow, f.creep_s,
        f.creep_floor, f.smooth_rad_s,
        t.coulomb_per_k, t.viscous_per_k, reference_c,
        d.ripple_nm, d.ripple_per_turn, d.ripple_phase_rad,
    )  # fmt: skip


def slip_elements(truth: Truth) -> FloatArray:
    """Return share of the limit and stiffness [N·m/rad] of each slip element, (2, n, E).

    Joints with fewer elements are padded with elements of share 0.
    """
    count = max(1, max(len(joint.friction.elements) for joint in truth.joints))
    table = np.zeros((2, len(truth.joints), count))
    for j, joint in enumerate(truth.joints):
        for k, (share, slip_rad) in enumerate(joint.friction.elements):
            table[:, j, k] = share, share * joint.friction.coulomb_nm / slip_rad
    return table


@njit(**COMPILED)
def friction_torque(
    law: Any,
    shares: FloatArray,
    stiffness: FloatArray,
    forces: FloatArray,
    q: float,
    v: float,
    load: float,
    celsius: float,
    scale: float,
    dt: float,
) -> float:
    """Advance the slip elements by one step and return the friction torque [N·m].

    Friction opposes motion: its effect on the joint is minus this torque.

    Args:
        law: Record of `LAW`.
        shares: Shares of the friction limit, (E,); see `slip_elements`.
        stiffness: (E,) stiffness of the elements [N·m/rad].
        forces: (E,) forces of the elements [N·m], updated in place.
        q: Joint position [rad].
        v: Joint speed [rad/s].
        load: Torque transmitted by the gear [N·m].
        celsius: Temperature of the joint [°C].
        scale: Wear factor of the joint; 1 for a new joint.
        dt: Integration step [s].
    """
    limit = scale * _slip_limit(law, v, load, celsius)
    if law.smooth > 0.0:
        dry = limit * math.tanh(v / law.smooth)
    else:
        dry = _advance_elements(law, shares, stiffness, forces, v, limit, dt)
    wet = scale * _viscous(law, v, celsius)
    ripple = law.ripple * math.sin(law.ripple_per_turn * q + law.ripple_phase)
    return float(dry + wet + law.offset + ripple)


@njit(**COMPILED)
def _slip_limit(law: Any, v: float, load: float, celsius: float) -> float:
    """Return the total friction of all slipping elements at speed `v`, without asymmetry."""
    warm = max(LEAST_WARM, 1.0 + law.coulomb_per_k * (celsius - law.reference_c))
    limit = law.coulomb * warm + law.load_share * abs(load)
    if law.stribeck > 0.0:
        cold = min(1.0, max(0.0, (STRIBECK_GONE_C - celsius) / (STRIBECK_GONE_C - COLD_C)))
        ratio = abs(v) / law.stribeck_speed
        if cold > 0.0 and ratio < STRIBECK_REACH:
            limit += cold * law.stribeck * math.exp(-(ratio**law.stribeck_shape))
    return float(limit)


@njit(**COMPILED)
def _advance_elements(
    law: Any,
    shares: FloatArray,
    stiffness: FloatArray,
    forces: FloatArray,
    v: float,
    limit: float,
    dt: float,
) -> float:
    """Advance every slip element (stick, slip, and creep at standstill); return the total force."""
    total = 0.0
    creep = dt / law.creep_s / (1.0 + (v / CREEP_RAD_S) ** 2)
    for k in range(forces.size):
        before = abs(forces[k])
        force = forces[k] + stiffness[k] * v * dt
        bound = shares[k] * limit * (1.0 + law.asymmetry * math.copysign(1.0, force))
        size = abs(force)
        if size > bound:
            # The element slips; it follows a decreasing bound (Stribeck) with a lag.
            size = max(bound, min(size, before + (bound - before) * law.slip_follow))
        floor = law.creep_floor * bound
        if size > floor:
            size -= (size - floor) * creep
        forces[k] = math.copysign(size, force)
        total += forces[k]
    return total


@njit(**COMPILED)
def _viscous(law: Any, v: float, celsius: float) -> float:
    warm = max(LEAST_WARM, 1.0 + law.viscous_per_k * (celsius - law.reference_c))
    torque = law.viscous * warm * v
    if law.viscous_power != 1.0:
        knee = VISCOUS_KNEE_RAD_S
        torque *= (v * v + knee * knee) ** (0.5 * (law.viscous_power - 1.0))
    return float(torque * (1.0 + law.asymmetry * math.copysign(1.0, v)))
