"""Random Fourier coefficients: how far they reach, how fast they get, and by how much to shrink."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.excitation.motion import FourierSeries
from hil.excitation.workspace import Workspace
from hil.spec import Fourier

SHRINKAGE = np.array([1.0, 0.8, 0.64, 0.5, 0.4, 0.3])
"""Tried from the largest: small motions excite little."""

COARSE = 64
POINTS_PER_HARMONIC = 256
"""Grid for peaks; a trigonometric polynomial of degree H on m·H points exceeds its largest value
there by a factor of 1/cos(π/m) at most (Ehlich and Zeller 1964)."""


@dataclass(frozen=True, slots=True, eq=False)
class Coefficients:
    """Series about zero: `a` and `b`, each (n, H) in rad/s, at rest at both ends."""

    a: FloatArray
    b: FloatArray

    def about(self, q0: FloatArray, scale: float, spec: Fourier, f_hz: float) -> FourierSeries:
        """The motion about `q0` (n,), everything multiplied by `scale`."""
        a, b = (_rows(scale * self.a), _rows(scale * self.b))
        return FourierSeries(tuple(map(float, q0)), a, b, f_hz, spec.periods)


def fitting_frequency(spec: Fourier, rate_hz: float) -> float:
    """The fundamental, lowered so that the trajectory ends on a sample [Hz]."""
    samples = int(np.ceil(spec.periods * rate_hz / spec.fundamental_hz - 1e-9))
    return spec.periods * rate_hz / samples


def about_zero(
    a: FloatArray, b: FloatArray, f_hz: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One period of q − q₀, qd and qdd, each (POINTS_PER_HARMONIC·H, n)."""
    zero = tuple(0.0 for _ in a)
    samples = FourierSeries(zero, _rows(a), _rows(b), f_hz).sample(
        POINTS_PER_HARMONIC * a.shape[1] * f_hz
    )
    return samples.q, samples.qd, samples.qdd


def extent(a: FloatArray, b: FloatArray, f_hz: float) -> tuple[FloatArray, FloatArray]:
    """(n,) least and (n,) most that q − q₀ ever is."""
    q, _, _ = about_zero(a, b, f_hz)
    beyond = np.abs(q).max(axis=0) * (1 / np.cos(np.pi / POINTS_PER_HARMONIC) - 1)
    return q.min(axis=0) - beyond, q.max(axis=0) + beyond


def coarse_scales(
    workspace: Workspace, drawn: list[tuple[Coefficients, FloatArray]], f_hz: float
) -> Sequence[float]:
    """For each draw the largest shrinkage that is clear on a coarse grid, 0 for none."""
    shapes = np.stack(
        [
            about_zero(c.a, c.b, f_hz)[0][:: POINTS_PER_HARMONIC * c.a.shape[1] // COARSE]
            for c, _ in drawn
        ]
    )
    centres = np.stack([q0 for _, q0 in drawn])
    q = centres[:, None, None] + SHRINKAGE[:, None, None] * shapes[:, None]
    draws, scales, points, n = q.shape
    clear = workspace.is_clear(q.reshape(-1, n)).reshape(draws, scales, points)
    largest: FloatArray = np.where(clear.all(axis=2), SHRINKAGE, 0.0).max(axis=1)
    return [float(scale) for scale in largest]


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)
