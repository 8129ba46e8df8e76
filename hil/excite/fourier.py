"""Fourier excitation: random feasible series per eq. 29 of the PINN paper, best of a few kept.

Each joint's series is drawn at random, made to rest at both ends, scaled to whatever limit binds
first, and shrunk towards its centre until the arm keeps its distance at every sample.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hil.errors import PlanError
from hil.excite.motion import FourierSeries
from hil.excite.roadmap import Roadmap
from hil.excite.visit import Action, Program, Visit
from hil.excite.workspace import Workspace
from hil.spec.experiment import Fourier
from hil.typing import FloatArray

CANDIDATES = 6
"""Feasible draws among which the best conditioned one is kept."""

MOST_DRAWS = 200
DRAWS_AT_ONCE = 12
SHRINKAGE = np.array([1.0, 0.8, 0.64, 0.5, 0.4, 0.3])
"""Tried from the largest: small motions excite little."""

COARSE = 64
POINTS_PER_HARMONIC = 256
"""Grid for peaks; a trigonometric polynomial of degree H on m·H points exceeds its largest value
there by a factor of 1/cos(π/m) at most (Ehlich and Zeller 1964)."""

SCORED = 100
"""Samples the condition number is computed from; enough for ranking (facts measured on a UR5)."""


@dataclass(frozen=True, slots=True, eq=False)
class Coefficients:
    """Series about zero: `a` and `b`, each (n, H) in rad/s, at rest at both ends."""

    a: FloatArray
    b: FloatArray

    def about(self, q0: FloatArray, scale: float, spec: Fourier, f_hz: float) -> FourierSeries:
        """The motion about `q0` (n,), everything multiplied by `scale`."""
        a, b = (_rows(scale * self.a), _rows(scale * self.b))
        return FourierSeries(tuple(map(float, q0)), a, b, f_hz, spec.periods)


class FourierExcitation:
    """Several Fourier trajectories, drawn by seed.

    Args:
        spec: The excitation part of an experiment.
        folder: Not used; part of what every excitation is given.
    """

    def __init__(self, spec: Fourier, folder: Path = Path()) -> None:
        self.spec = spec
        self.folder = folder

    def program(self, roadmap: Roadmap) -> Program:
        """One visit per trajectory, in order.

        Raises:
            PlanError: Random series hardly ever keep their distance.
        """
        visits = []
        for number in range(self.spec.trajectories):
            rng = np.random.default_rng([self.spec.seed, number])
            action = Action("trajectory", self._best(roadmap, rng), trajectory=number)
            visits.append(Visit((action,), f"trajectory {number}"))
        return Program(visits)

    def _best(self, roadmap: Roadmap, rng: np.random.Generator) -> FourierSeries:
        candidates = list(itertools.islice(self._feasible(roadmap, rng), CANDIDATES))
        return min(candidates, key=lambda series: _score(roadmap.workspace, series))

    def _feasible(self, roadmap: Roadmap, rng: np.random.Generator) -> Iterator[FourierSeries]:
        """Clear series that can be reached, as they are drawn.

        Raises:
            PlanError: After `MOST_DRAWS` draws.
        """
        workspace = roadmap.workspace
        f_hz = fitting_frequency(self.spec, workspace.rate_hz)
        for _ in range(0, MOST_DRAWS, DRAWS_AT_ONCE):
            drawn = [self._draw(workspace, rng, f_hz) for _ in range(DRAWS_AT_ONCE)]
            scales = _coarse_scales(workspace, drawn, f_hz)
            for (coefficients, q0), scale in zip(drawn, scales, strict=True):
                for smaller in SHRINKAGE[scale >= SHRINKAGE]:
                    series = coefficients.about(q0, float(smaller), self.spec, f_hz)
                    if _is_possible(roadmap, series):
                        yield series
                        break
        raise PlanError(
            f"not even {CANDIDATES} of {MOST_DRAWS} random Fourier series keep "
            f"{1e3 * workspace.clearance_m:.0f} mm from the table, the walls and the arm itself",
            hint="lower excitation.amplitude_deg or set excitation.range_deg where there is room",
        )

    def _draw(
        self, workspace: Workspace, rng: np.random.Generator, f_hz: float
    ) -> tuple[Coefficients, FloatArray]:
        """Random coefficients scaled to their limits, and a centre that keeps them in range."""
        n, order = len(workspace.low), np.arange(1, self.spec.harmonics + 1)
        a, b = rng.standard_normal((2, n, self.spec.harmonics))
        a -= a.mean(axis=1, keepdims=True)
        b -= (b @ order / (order @ order))[:, None] * order
        scale = self._largest_scale(workspace, a, b, f_hz) * rng.uniform(0.7, 1.0, (n, 1))
        least, most = _extent(a * scale, b * scale, f_hz)
        q0 = rng.uniform(workspace.low - least, workspace.high - most)
        return Coefficients(a * scale, b * scale), q0

    def _largest_scale(
        self, workspace: Workspace, a: FloatArray, b: FloatArray, f_hz: float
    ) -> FloatArray:
        """(n, 1) factor at which each joint reaches the first of its limits."""
        q, qd, qdd = _about_zero(a, b, f_hz)
        least, most = _extent(a, b, f_hz)
        slack = np.cos(np.pi / POINTS_PER_HARMONIC)
        factors = (
            (workspace.high - workspace.low) / (most - least),
            np.radians(self.spec.amplitude_deg) * slack / np.abs(q).max(axis=0),
            workspace.velocity * slack / np.abs(qd).max(axis=0),
            workspace.acceleration * slack / np.abs(qdd).max(axis=0),
        )
        smallest: FloatArray = np.min(factors, axis=0)
        return smallest[:, None]


def fitting_frequency(spec: Fourier, rate_hz: float) -> float:
    """The fundamental, lowered so that the trajectory ends on a sample [Hz]."""
    samples = int(np.ceil(spec.periods * rate_hz / spec.fundamental_hz - 1e-9))
    return spec.periods * rate_hz / samples


def _about_zero(
    a: FloatArray, b: FloatArray, f_hz: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One period of q − q₀, qd and qdd, each (POINTS_PER_HARMONIC·H, n)."""
    zero = tuple(0.0 for _ in a)
    samples = FourierSeries(zero, _rows(a), _rows(b), f_hz).sample(
        POINTS_PER_HARMONIC * a.shape[1] * f_hz
    )
    return samples.q, samples.qd, samples.qdd


def _extent(a: FloatArray, b: FloatArray, f_hz: float) -> tuple[FloatArray, FloatArray]:
    """(n,) least and (n,) most that q − q₀ ever is."""
    q, _, _ = _about_zero(a, b, f_hz)
    beyond = np.abs(q).max(axis=0) * (1 / np.cos(np.pi / POINTS_PER_HARMONIC) - 1)
    return q.min(axis=0) - beyond, q.max(axis=0) + beyond


def _coarse_scales(
    workspace: Workspace, drawn: list[tuple[Coefficients, FloatArray]], f_hz: float
) -> Sequence[float]:
    """For each draw the largest shrinkage that is clear on a coarse grid, 0 for none."""
    shapes = np.stack(
        [
            _about_zero(c.a, c.b, f_hz)[0][:: POINTS_PER_HARMONIC * c.a.shape[1] // COARSE]
            for c, _ in drawn
        ]
    )
    centres = np.stack([q0 for _, q0 in drawn])
    q = centres[:, None, None] + SHRINKAGE[:, None, None] * shapes[:, None]
    draws, scales, points, n = q.shape
    clear = workspace.is_clear(q.reshape(-1, n)).reshape(draws, scales, points)
    largest: FloatArray = np.where(clear.all(axis=2), SHRINKAGE, 0.0).max(axis=1)
    return [float(scale) for scale in largest]


def _is_possible(roadmap: Roadmap, series: FourierSeries) -> bool:
    reachable = bool(roadmap.seem_connected(series.q_start[None])[0])
    return reachable and roadmap.workspace.are_clear([series])


def _score(workspace: Workspace, series: FourierSeries) -> float:
    if workspace.condition is None:
        return 0.0
    period = replace(series, periods=1).sample(SCORED * series.fundamental_hz)
    return workspace.condition(period.q, period.qd, period.qdd)


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)
