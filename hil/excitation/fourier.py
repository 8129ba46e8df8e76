"""Fourier excitation: random feasible series per eq. 29 of the PINN paper, best of a few kept.

Each joint's series is drawn at random, made to rest at both ends, scaled to whatever limit binds
first, and shrunk towards its centre until the arm keeps its distance at every sample. A spec that
says `optimise` gets series from `hil.excitation.optimised` instead.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.core import FloatArray, PlanError
from hil.excitation.coefficients import (
    POINTS_PER_HARMONIC,
    SHRINKAGE,
    Coefficients,
    about_zero,
    coarse_scales,
    extent,
    fitting_frequency,
)
from hil.excitation.motion import FourierSeries
from hil.excitation.optimised import OptimisedSeries
from hil.excitation.question import Question
from hil.excitation.roadmap import Roadmap
from hil.excitation.setting import Setting
from hil.excitation.visit import Action, Program, Visit
from hil.excitation.workspace import Workspace
from hil.spec import Fourier

CANDIDATES = 6
"""Feasible draws among which the best conditioned one is kept."""

MOST_DRAWS = 200

SMALLEST = 0.1
"""Share of its limits that a motion is drawn with at least where the flange is confined."""
DRAWS_AT_ONCE = 12
SCORED = 100
"""Samples the condition number is computed from; enough for ranking (facts measured on a UR5)."""


class FourierExcitation:
    """Several Fourier trajectories, drawn by seed or optimised.

    Args:
        spec: The excitation part of an experiment.
        folder: Not used; part of what every excitation is given.
    """

    def __init__(self, spec: Fourier, folder: Path = Path()) -> None:
        self.spec = spec
        self.folder = folder
        self._setting: Setting | None = None

    def compute_with(self, setting: Setting) -> None:
        """The robot that trajectories are optimised for."""
        self._setting = setting

    def program(self, roadmap: Roadmap) -> Program:
        """One visit per trajectory, in order.

        Raises:
            PlanError: Random series hardly ever keep their distance, or none can be optimised.
        """
        visits = []
        for number, series in enumerate(self._series(roadmap)):
            action = Action("trajectory", series, trajectory=number)
            visits.append(Visit((action,), f"trajectory {number}"))
        return Program(visits)

    def _series(self, roadmap: Roadmap) -> list[FourierSeries]:
        if self.spec.optimise is None:
            seeds = [[self.spec.seed, number] for number in range(self.spec.trajectories)]
            return [self._best(roadmap, np.random.default_rng(seed)) for seed in seeds]
        if self._setting is None:
            raise PlanError(
                "trajectories cannot be optimised for a robot of which no model is given",
                hint="call compute_with before program, as hil.plan does",
            )
        f_hz = fitting_frequency(self.spec, roadmap.workspace.rate_hz)
        question = Question(self.spec, roadmap.workspace, self._setting, f_hz)
        return OptimisedSeries(question, roadmap).all()

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
        for share in _shares(workspace):
            drawn = [self._draw(roadmap, rng, f_hz, share) for _ in range(DRAWS_AT_ONCE)]
            scales = coarse_scales(workspace, drawn, f_hz)
            for (coefficients, q0), scale in zip(drawn, scales, strict=True):
                for smaller in SHRINKAGE[scale >= SHRINKAGE]:
                    series = coefficients.about(q0, float(smaller), self.spec, f_hz)
                    if _is_possible(roadmap, series):
                        yield series
                        break
        raise self._too_few(roadmap, drawn[-1])

    def _too_few(self, roadmap: Roadmap, last: tuple[Coefficients, FloatArray]) -> PlanError:
        """Return the error for too few clear series, with what is in the way of the `last` draw."""
        workspace = roadmap.workspace
        f_hz = fitting_frequency(self.spec, workspace.rate_hz)
        smallest = last[0].about(last[1], float(SHRINKAGE[-1]), self.spec, f_hz)
        why = workspace.obstacle([smallest])
        draws = DRAWS_AT_ONCE * len(list(_shares(workspace)))
        return PlanError(
            f"not even {CANDIDATES} of {draws} random Fourier series keep "
            f"{1e3 * workspace.clearance_m:.0f} mm from the table, the walls and the arm itself"
            + (" and inside the workspace" if workspace.space is not None else "")
            + (f"; last series tried: {why}" if why else ""),
            hint=f"{workspace.larger_space}lower excitation.amplitude_deg or set "
            "excitation.range_deg where there is room",
        )

    def _draw(
        self, roadmap: Roadmap, rng: np.random.Generator, f_hz: float, share: float | None
    ) -> tuple[Coefficients, FloatArray]:
        """Random coefficients scaled to their limits, and a centre that keeps them in range.

        With a `share`, only to so much of the limits, and about a pose of the roadmap.
        """
        workspace = roadmap.workspace
        n, order = len(workspace.low), np.arange(1, self.spec.harmonics + 1)
        a, b = rng.standard_normal((2, n, self.spec.harmonics))
        a -= a.mean(axis=1, keepdims=True)
        b -= (b @ order / (order @ order))[:, None] * order
        scale = self._largest_scale(workspace, a, b, f_hz) * rng.uniform(0.7, 1.0, (n, 1))
        scale *= 1.0 if share is None else share
        least, most = extent(a * scale, b * scale, f_hz)
        low, high = workspace.low - least, workspace.high - most
        q0 = rng.uniform(low, high)
        if share is not None:
            q0 = np.clip(rng.choice(roadmap.poses), low, high)
        return Coefficients(a * scale, b * scale), q0

    def _largest_scale(
        self, workspace: Workspace, a: FloatArray, b: FloatArray, f_hz: float
    ) -> FloatArray:
        """(n, 1) factor at which each joint reaches the first of its limits."""
        q, qd, qdd = about_zero(a, b, f_hz)
        least, most = extent(a, b, f_hz)
        slack = np.cos(np.pi / POINTS_PER_HARMONIC)
        factors = (
            (workspace.high - workspace.low) / (most - least),
            np.radians(self.spec.amplitude_deg) * slack / np.abs(q).max(axis=0),
            workspace.velocity * slack / np.abs(qd).max(axis=0),
            workspace.acceleration * slack / np.abs(qdd).max(axis=0),
        )
        smallest: FloatArray = np.min(factors, axis=0)
        return smallest[:, None]


def _shares(workspace: Workspace) -> Iterator[float | None]:
    """Yield, for each lot of draws, the share of the limits they are scaled to; None for all.

    Few poses of the joint ranges keep a confined flange inside its space, so draws about any of
    them may all fail. Then smaller and smaller motions are drawn about poses known to be inside.
    """
    lots = -(-MOST_DRAWS // DRAWS_AT_ONCE)
    yield from [None] * lots
    if workspace.space is not None:
        yield from np.geomspace(1.0, SMALLEST, lots).tolist()


def _is_possible(roadmap: Roadmap, series: FourierSeries) -> bool:
    reachable = bool(roadmap.seem_connected(series.q_start[None])[0])
    return reachable and roadmap.workspace.are_clear([series])


def _score(workspace: Workspace, series: FourierSeries) -> float:
    if workspace.condition is None:
        return 0.0
    period = replace(series, periods=1).sample(SCORED * series.fundamental_hz)
    return workspace.condition(period.q, period.qd, period.qdd)
