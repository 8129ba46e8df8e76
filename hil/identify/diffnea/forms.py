"""Friction as columns whose shape a few numbers bend, with exact derivatives.

Every joint's friction is C(q̇; s)·c: coefficients c, of which dissipation keeps some from being
negative, and shapes s within bounds. sgn stands for tanh(q̇/width) throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.typing import BoolArray, FloatArray

LEAST_SPEED = 1e-9
"""Added to |q̇| before a power or a logarithm of it [rad/s]."""

Columns = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""q̇ (N,), sgn (N,), s (S,) → C (N, k) and ∂C/∂s (N, k, S)."""


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
    """

    terms: tuple[str, ...]
    signs: tuple[bool, ...]
    shapes: tuple[Shape, ...]
    columns: Columns

    @property
    def nonnegative(self) -> BoolArray:
        """(k,) which coefficients cannot be negative."""
        return np.array(self.signs)

    def evaluate(
        self, qd: FloatArray, sign: FloatArray, shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """C (N, n, k) and ∂C/∂s (N, n, k, S) of all joints.

        Args:
            qd: (N, n) [rad/s].
            sign: (N, n) its smoothed sign.
            shapes: (n, S).
        """
        joints = range(qd.shape[1])
        found = [self.columns(qd[:, j], sign[:, j], shapes[j]) for j in joints]
        columns, slopes = zip(*found, strict=True)
        return np.stack(columns, axis=1), np.stack(slopes, axis=1)


def spread(columns: FloatArray) -> FloatArray:
    """(N·n, n·k) regressor, sample-major, of columns (N, n, k) that belong to their own joint."""
    samples, joints, k = columns.shape
    out = np.zeros((samples, joints, joints, k))
    out[:, np.arange(joints), np.arange(joints)] = columns
    return out.reshape(samples * joints, joints * k)


def sign_of(qd: FloatArray, width: float) -> FloatArray:
    """tanh(q̇/width), or the hard sign where the width is 0."""
    return np.tanh(qd / width) if width > 0 else np.sign(qd)


def _coulomb_viscous(
    qd: FloatArray, sign: FloatArray, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    return np.stack([sign, qd, np.ones_like(qd)], axis=-1), np.zeros((len(qd), 3, 0))


def _stribeck(qd: FloatArray, sign: FloatArray, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    speed, exponent = shape[0], shape[1]
    z = (np.abs(qd) + LEAST_SPEED) / speed
    power = z**exponent
    bump = np.exp(-power)
    C = np.stack([sign * (1.0 - bump), sign * bump, qd, np.ones_like(qd)], axis=-1)
    slope = np.zeros((len(qd), 4, 2))
    slope[:, 1, 0] = sign * bump * power * exponent / speed
    slope[:, 1, 1] = -sign * bump * power * np.log(z)
    slope[:, 0] = -slope[:, 1]
    return C, slope


def _stribeck_power(
    qd: FloatArray, sign: FloatArray, shape: FloatArray
) -> tuple[FloatArray, FloatArray]:
    C, inner = _stribeck(qd, sign, shape[:2])
    speed = np.abs(qd) + LEAST_SPEED
    C[:, 2] = sign * speed ** shape[2]
    slope = np.zeros((len(qd), 4, 3))
    slope[:, :, :2] = inner
    slope[:, 2, 2] = C[:, 2] * np.log(speed)
    return C, slope


_STRIBECK = (
    Shape("stribeck_velocity", 0.1, 0.01, 1.0),
    Shape("stribeck_exponent", 1.0, 0.5, 2.5),
)
_EXPONENT = Shape("speed_exponent", 0.8, 0.2, 1.5)
_TERMS, _SIGNS = ("coulomb", "static", "viscous", "offset"), (True, True, True, False)

FORMS = {
    "coulomb-viscous": Form(
        ("coulomb", "viscous", "offset"), (True, True, False), (), _coulomb_viscous
    ),
    "stribeck": Form(_TERMS, _SIGNS, _STRIBECK, _stribeck),
    "stribeck-power": Form(_TERMS, _SIGNS, (*_STRIBECK, _EXPONENT), _stribeck_power),
}
"""Friction laws by name: Fc, Fv, offset; [Fc + (Fs − Fc) exp(−|q̇/vs|^δ)] sgn + Fv q̇ + offset;
and the same with Fv |q̇|^α sgn (PINN paper eq. 15–18)."""
