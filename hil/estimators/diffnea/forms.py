"""Friction as columns whose shape a few numbers bend, with exact derivatives.

Every joint's friction is C(motion; s)·c: coefficients c, of which dissipation keeps some from being
negative, and shapes s within bounds. Without memory, sgn stands for tanh(q̇/width); with it, z is
Dahl's state (`hil.estimators.friction_memory`) and τ the torque through the gear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.estimators.diffnea.motion import ArmMotion, JointMotion

LEAST_SPEED = 1e-9
"""Added to |q̇| before a power or a logarithm of it [rad/s]."""

LONG = 10.0
"""Length of the second state, as a multiple of the first."""

Columns = Callable[[JointMotion, FloatArray], tuple[FloatArray, FloatArray]]
"""Motion of N samples, s (S,) → C (N, k) and ∂C/∂s (N, k, S)."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A number that bends columns.

    Attributes:
        name: As parameters are named.
        start: Where the search begins.
        low, high: Bounds; the search goes by logarithm between them.
    """

    name: str
    start: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Form:
    """A friction law.

    Attributes:
        terms: Names of the k coefficients per joint.
        signs: (k,) true where a coefficient cannot be negative.
        shapes: What bends the columns; empty for a law that is linear.
        columns: Evaluates them.
        multiples: Lengths of the states it carries, as multiples of its first shape; empty for
            a law without memory.
    """

    terms: tuple[str, ...]
    signs: tuple[bool, ...]
    shapes: tuple[Shape, ...]
    columns: Columns
    multiples: tuple[float, ...] = ()

    @property
    def nonnegative(self) -> BoolArray:
        """(k,) which coefficients cannot be negative."""
        return np.array(self.signs)

    def evaluate(self, motion: ArmMotion, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """C (N, n, k) and ∂C/∂s (N, n, k, S) of all joints with shapes (n, S)."""
        found = [self.columns(motion.joint(j), shape) for j, shape in enumerate(shapes)]
        columns, slopes = zip(*found, strict=True)
        return np.stack(columns, axis=1), np.stack(slopes, axis=1)


def spread(columns: FloatArray) -> FloatArray:
    """(N·n, n·k) regressor, sample-major, of columns (N, n, k) that belong to their own joint."""
    samples, joints, k = columns.shape
    out = np.zeros((samples, joints, joints, k))
    out[:, np.arange(joints), np.arange(joints)] = columns
    return out.reshape(samples * joints, joints * k)


def _coulomb_viscous(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    qd = motion.qd
    return np.stack([motion.sign, qd, np.ones_like(qd)], axis=-1), np.zeros((len(qd), 3, 0))


def _stribeck(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    qd, sign, (speed, exponent) = motion.qd, motion.sign, shape
    z = (np.abs(qd) + LEAST_SPEED) / speed
    power = z**exponent
    peak = np.exp(-power)
    C = np.stack([sign * (1.0 - peak), sign * peak, qd, np.ones_like(qd)], axis=-1)
    slope = np.zeros((len(qd), 4, 2))
    slope[:, 1, 0] = sign * peak * power * exponent / speed
    slope[:, 1, 1] = -sign * peak * power * np.log(z)
    slope[:, 0] = -slope[:, 1]
    return C, slope


def _stribeck_power(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    C, inner = _stribeck(motion, shape[:2])
    C[:, 2], by_exponent = _power(motion, shape[2])
    slope = np.zeros((len(C), 4, 3))
    slope[:, :, :2] = inner
    slope[:, 2, 2] = by_exponent
    return C, slope


def _memory(motion: JointMotion, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    length, speed, exponent = shape
    z, dz = motion.state(length, 1.0)
    far, dfar = motion.state(length, LONG)
    load, ratio = np.abs(motion.transmitted), np.abs(motion.qd) / speed
    peak = np.exp(-ratio)
    law, by_exponent = _power(motion, exponent)
    one = np.ones_like(z)
    C = np.stack([z * (1.0 - peak), z * peak, z * load, law, motion.qd, one, far, far * load])
    slope = np.zeros((3, *C.shape))
    slope[0, [0, 1, 2, 6, 7]] = [dz * (1.0 - peak), dz * peak, dz * load, dfar, dfar * load]
    slope[1, 1] = z * peak * ratio / speed
    slope[1, 0] = -slope[1, 1]
    slope[2, 3] = by_exponent
    return C.T, slope.T.copy()


def _power(motion: JointMotion, exponent: float) -> tuple[FloatArray, FloatArray]:
    """sgn·|q̇|^α and its derivative by α."""
    speed = np.abs(motion.qd) + LEAST_SPEED
    law = motion.sign * speed**exponent
    return law, law * np.log(speed)


_STRIBECK = (
    Shape("stribeck_velocity", 0.1, 0.01, 1.0),
    Shape("stribeck_exponent", 1.0, 0.5, 2.5),
)
_EXPONENT = Shape("speed_exponent", 0.8, 0.2, 1.5)
_TERMS, _SIGNS = ("coulomb", "static", "viscous", "offset"), (True, True, True, False)

_REMEMBERING = Form(
    ("coulomb", "static", "load", "speed", "viscous", "offset", "memory", "memory_load"),
    (True, True, True, True, True, False, False, False),
    (
        Shape("dahl_length", 2e-4, 3e-5, 3e-3),
        Shape("stribeck_velocity", 0.1, 0.02, 0.5),
        Shape("speed_exponent", 0.35, 0.15, 0.85),
    ),
    _memory,
    (1.0, LONG),
)

FORMS = {
    "coulomb-viscous": Form(
        ("coulomb", "viscous", "offset"), (True, True, False), (), _coulomb_viscous
    ),
    "stribeck": Form(_TERMS, _SIGNS, _STRIBECK, _stribeck),
    "stribeck-power": Form(_TERMS, _SIGNS, (*_STRIBECK, _EXPONENT), _stribeck_power),
    "memory": _REMEMBERING,
}
"""Friction laws by name: Fc, Fv, offset; [Fc + (Fs − Fc) exp(−|q̇/vs|^δ)] sgn + Fv q̇ + offset;
the same with Fv |q̇|^α sgn (PINN paper eq. 15–18); and [Fc + (Fs − Fc) exp(−|q̇/vs|) + g |τ|] z
+ Fp |q̇|^α sgn + Fv q̇ + offset, with a longer state z₁₀, by itself and times |τ|."""
