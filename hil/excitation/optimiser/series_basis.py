"""Fourier series that rest at both ends, as a linear map from their free coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from hil.core import FloatArray
from hil.excitation.motion import FourierSeries


class Grid(NamedTuple):
    """The map on a grid of one period: each (N, f), times free coefficients (f, n).

    `jerk` is the derivative of `qdd` [rad/s³].
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    jerk: FloatArray


@dataclass(frozen=True)
class SeriesBasis:
    """Series of eq. 29 of the PINN paper with Σ aᵢ = 0 and Σ i·bᵢ = 0 for every joint.

    Of the 2H + 1 coefficients of a joint 2H − 1 are free: its centre q₀ [rad], then the coordinates
    of a and of b in the null spaces of the two conditions [rad/s]. The free coefficients of an arm
    are an array (n, 2H − 1).

    Attributes:
        harmonics: H, at least 2.
        fundamental_hz: ω/2π.
    """

    harmonics: int
    fundamental_hz: float

    @property
    def free(self) -> int:
        """Number of free coefficients of a joint."""
        return 2 * self.harmonics - 1

    def grid(self, points: int) -> Grid:
        """The map at t = 0, 1/points, … of one period, its end left out."""
        omega = 2.0 * np.pi * self.fundamental_hz * self._order
        phase = 2.0 * np.pi * np.outer(np.arange(points) / points, self._order)
        sin, cos, one = np.sin(phase), np.cos(phase), np.ones((points, 1))
        A, B = self._rest
        maps = (
            (one, (sin / omega) @ A, (-cos / omega) @ B),
            (0.0 * one, cos @ A, sin @ B),
            (0.0 * one, (-sin * omega) @ A, (cos * omega) @ B),
            (0.0 * one, (-cos * omega**2) @ A, (-sin * omega**2) @ B),
        )
        return Grid(*(np.hstack(parts) for parts in maps))

    def series(self, free: FloatArray, periods: int = 1) -> FourierSeries:
        """The motion with free coefficients (n, f)."""
        (A, B), split = self._rest, self.harmonics
        a, b = _rows(free[:, 1:split] @ A.T), _rows(free[:, split:] @ B.T)
        return FourierSeries(tuple(map(float, free[:, 0])), a, b, self.fundamental_hz, periods)

    def coefficients(self, series: FourierSeries) -> FloatArray:
        """(n, f) free coefficients of a series; what does not rest at its ends is projected."""
        A, B = self._rest
        return np.column_stack([series.q0, np.array(series.a) @ A, np.array(series.b) @ B])

    @property
    def _order(self) -> FloatArray:
        return np.arange(1.0, self.harmonics + 1)

    @property
    def _rest(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal bases (H, H − 1) of the a and of the b that rest at both ends."""
        conditions = np.ones((1, self.harmonics)), self._order[None]
        A, B = (scipy.linalg.null_space(row) for row in conditions)
        return A, B


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)
