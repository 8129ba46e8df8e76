"""Fourier excitation: several trajectories (eq. 29, PINN paper), drawn at random or optimised.

Drawn trajectories: the series of each joint is random, at rest at both ends, and scaled to the
first limit that it reaches. A drawn motion is shrunk towards its centre until the arm keeps the
required distance at every sample. The motion with the best condition number is selected from a few
drawn motions.

Optimised trajectories (`optimise` in the spec): the search for a trajectory includes the
information of all earlier trajectories. Condition number and determinant are therefore those of all
trajectories together. The first k optimised trajectories do not depend on the requested number. A
request for more trajectories therefore continues from the cached ones.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FloatArray, PlanError, RecordingError
from hil.excitation.cache import DamagedEntry, digest
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser import Progress, optimise
from hil.excitation.problem import ExcitationProblem
from hil.excitation.program import Action, Advance, Program, Setting, Visit
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace
from hil.spec import Fourier, Optimise

CANDIDATES = 6
"""Number of feasible draws, from which the draw with the best condition number is selected."""

MOST_DRAWS = 200

SMALLEST = 0.1
"""Minimum share of the limits to which a drawn motion is scaled if the flange is confined."""

DRAWS_AT_ONCE = 12

SCORED = 100
"""Number of samples from which the condition number of a draw is computed; sufficient to rank draws
(measured on a UR5).
"""

SHRINKAGE = np.array([1.0, 0.8, 0.64, 0.5, 0.4, 0.3])
"""Factors by which a drawn motion is scaled; the largest is tried first, because small motions
excite little.
"""

POINTS_PER_HARMONIC = 256
"""Number of grid points per harmonic on which peak values are computed. A trigonometric polynomial
of degree H, sampled at m·H points, exceeds its largest sample by a factor of at most 1/cos(π/m)
(Ehlich and Zeller 1964).
"""


class FourierExcitation:
    """Excitation with several Fourier trajectories, drawn with a seed or optimised.

    Args:
        spec: Excitation section of an experiment.
        folder: Folder of the spec, which this excitation does not use.
    """

    def __init__(self, spec: Fourier, folder: Path = Path()) -> None:
        self.spec = spec
        self.folder = folder
        self._setting: Setting | None = None

    def compute_with(self, setting: Setting) -> None:
        """Store the robot model and payloads for which trajectories are optimised."""
        self._setting = setting

    def program(self, roadmap: Roadmap) -> Program:
        """Return a program with one visit per trajectory, in order.

        Raises:
            PlanError: Too few random series keep the required distance, or the optimisation found
                no trajectory.
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
                "trajectories cannot be optimised for a robot without a model",
                hint="call compute_with before program, as hil.plan does",
            )
        f_hz = fitting_frequency(self.spec, roadmap.workspace.rate_hz)
        question = Question(self.spec, roadmap.workspace, self._setting, f_hz)
        return OptimisedSeries(question, roadmap).all()

    def _best(self, roadmap: Roadmap, rng: np.random.Generator) -> FourierSeries:
        candidates = list(itertools.islice(self._feasible(roadmap, rng), CANDIDATES))
        return min(candidates, key=lambda series: _score(roadmap.workspace, series))

    def _feasible(self, roadmap: Roadmap, rng: np.random.Generator) -> Iterator[FourierSeries]:
        """Yield the series that are clear and reachable, in the order of their draws.

        Raises:
            PlanError: All draws are used up without enough feasible series.
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
        """Return the error for too few clear series; it names the obstacle of the `last` draw."""
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
            hint=f"{workspace.larger_space}lower excitation.amplitude_deg, or limit "
            "excitation.range_deg to an unobstructed part of the workspace",
        )

    def _draw(
        self, roadmap: Roadmap, rng: np.random.Generator, f_hz: float, share: float | None
    ) -> tuple[Coefficients, FloatArray]:
        """Return random coefficients scaled to their limits, and a centre within range.

        If `share` is set, the drawn motion is scaled to this share of the limits and its centre is
        a pose of the roadmap.
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
        """Return for each joint, (n, 1), the scale factor at which it reaches its first limit."""
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


def _score(workspace: Workspace, series: FourierSeries) -> float:
    if workspace.condition is None:
        return 0.0
    period = replace(series, periods=1).sample(SCORED * series.fundamental_hz)
    return workspace.condition(period.q, period.qd, period.qdd)


def _shares(workspace: Workspace) -> Iterator[float | None]:
    """Yield the share of the limits to scale each block of draws to; None for the full limits.

    If the flange is confined, few poses within the joint ranges have the flange inside its space.
    All motions drawn about random poses may then be rejected. For a confined flange, smaller and
    smaller motions are drawn about poses whose flange is known to be inside its space.
    """
    lots = -(-MOST_DRAWS // DRAWS_AT_ONCE)
    yield from [None] * lots
    if workspace.space is not None:
        yield from np.geomspace(1.0, SMALLEST, lots).tolist()


def _is_possible(roadmap: Roadmap, series: FourierSeries) -> bool:
    reachable = bool(roadmap.seem_connected(series.q_start[None])[0])
    return reachable and roadmap.workspace.are_clear([series])


COARSE = 64


@dataclass(frozen=True, slots=True, eq=False)
class Coefficients:
    """Coefficients `a`, `b`, (n, H) [rad/s], of series about zero with rest at both ends."""

    a: FloatArray
    b: FloatArray

    def about(self, q0: FloatArray, scale: float, spec: Fourier, f_hz: float) -> FourierSeries:
        """Return the motion about `q0` (n,) with all coefficients multiplied by `scale`."""
        a, b = (_rows(scale * self.a), _rows(scale * self.b))
        return FourierSeries(tuple(map(float, q0)), a, b, f_hz, spec.periods)


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)


def fitting_frequency(spec: Fourier, rate_hz: float) -> float:
    """Return the fundamental frequency [Hz], lowered for the trajectory to end on a sample."""
    samples = int(np.ceil(spec.periods * rate_hz / spec.fundamental_hz - 1e-9))
    return spec.periods * rate_hz / samples


def about_zero(
    a: FloatArray, b: FloatArray, f_hz: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return one period of q − q₀, qd and qdd, each (POINTS_PER_HARMONIC·H, n)."""
    zero = tuple(0.0 for _ in a)
    samples = FourierSeries(zero, _rows(a), _rows(b), f_hz).sample(
        POINTS_PER_HARMONIC * a.shape[1] * f_hz
    )
    return samples.q, samples.qd, samples.qdd


def extent(a: FloatArray, b: FloatArray, f_hz: float) -> tuple[FloatArray, FloatArray]:
    """Return bounds of q − q₀ over all times: the smallest (n,) and the largest (n,) value."""
    q, _, _ = about_zero(a, b, f_hz)
    beyond = np.abs(q).max(axis=0) * (1 / np.cos(np.pi / POINTS_PER_HARMONIC) - 1)
    return q.min(axis=0) - beyond, q.max(axis=0) + beyond


def coarse_scales(
    workspace: Workspace, drawn: list[tuple[Coefficients, FloatArray]], f_hz: float
) -> Sequence[float]:
    """Return for each draw the largest scale factor that is clear on a coarse grid, or else 0."""
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


ATTEMPTS = 3
"""Number of searches for one trajectory: a clear motion can still be out of reach."""

SCALES = (1.0, 0.99, 0.95, 0.9, 0.8)
"""Factors on an optimised motion, tried from the largest if the motion is not clear at the
command rate."""

TOLERANCE = 1e-9
"""Rounding tolerance of limit checks, equal to the tolerance for the margins of a plan."""

ANSWERS = 2
"""Version number of the optimisation results, part of the cache key. The version number is raised
if the same request leads to different trajectories than before. Cached trajectories of an earlier
version are then not used.
"""

TOLERANCE_M = 1e-9


@dataclass(frozen=True, eq=False)
class Question:
    """Request for the optimised trajectories of a spec in a workspace.

    Attributes:
        spec: Excitation section with `optimise` set.
        workspace: Workspace of the arm.
        setting: Robot model, payloads and trajectory cache.
        f_hz: Fundamental frequency [Hz], chosen such that each trajectory ends exactly on a sample.
    """

    spec: Fourier
    workspace: Workspace
    setting: Setting
    f_hz: float

    @property
    def asked(self) -> Optimise:
        """Optimisation settings of the spec."""
        assert self.spec.optimise is not None
        return self.spec.optimise

    @property
    def key(self) -> str:
        """Hash of all inputs of the trajectories, except their number."""
        return digest(self._facts())

    def _facts(self) -> dict[str, Any]:
        workspace, asked = self.workspace, self.asked.model_dump(mode="json")
        return {
            "answers": ANSWERS,
            "optimise": asked | {"seed": self.seed},
            "series": [self.spec.harmonics, self.f_hz, self.spec.periods],
            "limits": [
                workspace.velocity,
                workspace.acceleration,
                self.clearance_m,
                *(each.tolist() for each in (workspace.low, workspace.high)),
                *(each.tolist() for each in (workspace.q_min, workspace.q_max)),
                self.setting.effort_max.tolist(),
            ],
            "rate_hz": workspace.rate_hz,
            "robot": self.setting.robot.to_dict(),
            "parameters": self.setting.robot.parameters().tolist(),
            "heaviest": repr(self.setting.heaviest),
            "place": dict(self.setting.identity),
        }

    @property
    def seed(self) -> int:
        """Seed of the search for trajectories."""
        return self.spec.seed if self.asked.seed is None else self.asked.seed

    @property
    def clearance_m(self) -> float:
        """Required distance to all bodies [m].

        Raises:
            PlanError: The distance required by the spec is smaller than the distance required by
                the station.
        """
        station = self.workspace.clearance_m
        if self.asked.clearance_mm is None:
            return station
        if 1e-3 * self.asked.clearance_mm < station - TOLERANCE_M:
            raise PlanError(
                f"excitation.optimise.clearance_mm: {self.asked.clearance_mm:g} mm is less than "
                f"the {1e3 * station:g} mm that the station requires",
                hint="remove it, or lower surroundings.clearance_m of the station's robot",
            )
        return 1e-3 * self.asked.clearance_mm

    def problem(self, found: Sequence[FourierSeries]) -> ExcitationProblem:
        """Return the optimisation problem of the trajectory that follows those in `found`."""
        workspace, asked = self.workspace, self.asked
        jerk = asked.max_jerk_deg_s3
        problem = ExcitationProblem(
            robot=self.setting.robot.with_payload(self.setting.heaviest),
            q_min=workspace.low,
            q_max=workspace.high,
            qd_max=workspace.velocity,
            qdd_max=workspace.acceleration,
            jerk_max=None if jerk is None else float(np.radians(jerk)),
            effort_max=asked.torque_percent / 100 * self.setting.effort_max,
            harmonics=self.spec.harmonics,
            fundamental_hz=self.f_hz,
            periods=self.spec.periods,
            objective=asked.objective,
            scaled=asked.scaled,
            rotor=asked.rotor,
            friction=asked.friction,
            collision=self.setting.collision,
            space=workspace.space,
            clearance_m=self.clearance_m,
        )
        return problem.after(*found) if found else problem


@dataclass(eq=False)
class OptimisedSeries:
    """Optimised trajectories of a request, read from the cache or computed.

    Attributes:
        question: Request for trajectories.
        roadmap: Clear paths between poses.
    """

    question: Question
    roadmap: Roadmap
    _began: float = 0.0
    _took_s: list[float] = field(default_factory=list)

    def all(self) -> list[FourierSeries]:
        """Return the requested number of trajectories: cached ones, then newly computed ones.

        Raises:
            PlanError: The search found no motion within all limits.
        """
        wanted, key = self.question.spec.trajectories, self.question.key
        found = self._kept(key)
        for _ in range(len(found), wanted):
            self._began = time.monotonic()
            found.append(self._next(found))
            self._took_s.append(time.monotonic() - self._began)
            self._keep(key, found)
        return found[:wanted]

    def _next(self, found: Sequence[FourierSeries]) -> FourierSeries:
        """Compute the next trajectory of the request.

        Raises:
            PlanError: No trajectory was found for the request.
        """
        number, problem = len(found) + 1, self.question.problem(found)
        if self.roadmap.workspace.space is not None:
            # Random poses are rarely inside the space, whereas all poses of the roadmap are.
            problem = replace(problem, centres=self.roadmap.poses)
        failure = PlanError(
            f"trajectory {number}: {ATTEMPTS} optimised motions keep their limits, but no path to "
            "their start keeps the required clearance",
            hint="raise excitation.optimise.starts, or limit excitation.range_deg to an "
            "unobstructed part of the workspace",
        )
        for attempt in range(ATTEMPTS):
            try:
                best = self._search(problem, number, attempt)
            except PlanError as error:
                failure = PlanError(f"trajectory {number}: {error.message}", hint=error.hint)
                continue
            for scale in SCALES:
                if self._is_possible(series := scaled(best, scale)):
                    return series
        raise failure

    def _search(self, problem: ExcitationProblem, number: int, attempt: int) -> FourierSeries:
        """Return the best motion of one search for a trajectory.

        Raises:
            PlanError: The search found no motion within all limits.
        """
        seeds = np.random.SeedSequence([self.question.seed, number, attempt])
        return optimise(
            problem,
            starts=self.question.asked.starts,
            seed=int(seeds.generate_state(1)[0]),
            progress=lambda progress: self._tell(number, progress),
            cpu_s=self.question.asked.budget_s,
        ).series

    def _is_possible(self, series: FourierSeries) -> bool:
        """Return whether a series is within limits, clear of collisions and reachable."""
        workspace = self.roadmap.workspace
        return (
            _is_within(workspace, series)
            and bool(workspace.depths([series])[0] >= self.question.clearance_m - TOLERANCE)
            and bool(workspace.clearances([series])[0] >= self.question.clearance_m - TOLERANCE)
            and self.roadmap.way(self.roadmap.home, series.q_start) is not None
        )

    def _kept(self, key: str) -> list[FourierSeries]:
        """Return the cached trajectories, or an empty list if one is not possible here."""
        try:
            kept = self.question.setting.cache.read(key)
        except DamagedEntry as damage:
            self.question.setting.watch(
                Advance(note=f"{damage}; the trajectories are computed again")
            )
            return []
        return list(kept) if all(map(self._is_possible, kept)) else []

    def _keep(self, key: str, found: Sequence[FourierSeries]) -> None:
        try:
            self.question.setting.cache.write(key, found)
        except RecordingError as error:
            self._note(f"{error.message}; the trajectories will be computed again next time")

    def _note(self, text: str) -> None:
        self.question.setting.watch(Advance(note=text))

    def _tell(self, number: int, progress: Progress) -> None:
        asked = self.question.asked
        best = progress.best if asked.objective == "condition" else float("inf")
        total, start = self.question.spec.trajectories, progress.start + 1
        left = self._left_s(total - number, progress.eta_s)
        self.question.setting.watch(Advance(number, total, start, progress.starts, best, left))

    def _left_s(self, others: int, eta_s: float | None) -> float | None:
        """Return the estimated time for the current and `others` further trajectories [s].

        The search cannot predict its convergence. The mean duration of earlier searches is
        therefore preferred to the estimate `eta_s` of the current search.
        """
        now = time.monotonic()
        if not self._took_s:
            return None if eta_s is None else (now - self._began + eta_s) * others + eta_s
        each = sum(self._took_s) / len(self._took_s)
        own = max(each - (now - self._began), 0.1 * each)
        return each * others + (own if eta_s is None else min(own, eta_s))


def _is_within(workspace: Workspace, series: FourierSeries) -> bool:
    samples = series.sample(workspace.rate_hz)
    return bool(
        np.abs(samples.qd).max() <= workspace.velocity + TOLERANCE
        and np.abs(samples.qdd).max() <= workspace.acceleration + TOLERANCE
        and np.all(samples.q >= workspace.low - TOLERANCE)
        and np.all(samples.q <= workspace.high + TOLERANCE)
    )


def scaled(series: FourierSeries, scale: float) -> FourierSeries:
    """Return the motion with all its coefficients multiplied by `scale`, about the same centre."""
    a, b = (
        tuple(tuple(scale * value for value in row) for row in rows)
        for rows in (series.a, series.b)
    )
    return replace(series, a=a, b=b)
