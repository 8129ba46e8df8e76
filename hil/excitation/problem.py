"""What is asked of an optimised Fourier trajectory: its series, its objective and its limits.

A motion is an array of free coefficients (n, f): the null space of the conditions for rest at both
ends (`SeriesBasis`) leaves f = 2H − 1 of them per joint. Everything an optimiser needs is given as
a function of them with its exact derivative:

- `ValueOf`: condition number or determinant of the base regressor, earlier trajectories included;
- `LinearLimits`: position, speed, acceleration and jerk, kept at all times and not just at the
  points of a grid: a trigonometric polynomial of degree H on m·H points exceeds its largest
  absolute value there by a factor of 1/cos(π/m) at most (Ehlich and Zeller 1964), and so much is
  taken off every limit;
- `MotionLimits`: torques of the nominal model, and distances to everything.

`margins_of` says what a finished series leaves of each limit, on a grid ten times denser.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
import scipy.linalg

from hil.core import BoolArray, FloatArray, IntArray, PlanError
from hil.dynamics import IdentificationColumns, log_condition, neg_log_det
from hil.excitation.motion import FourierSeries
from hil.excitation.workspace import Distances

if TYPE_CHECKING:
    from hil.dynamics import BaseParameters, RobotModel


Objective = Literal["condition", "log_det"]

SAMPLES_PER_HARMONIC = 20
"""Of the grid the objective is computed on: five harmonics give the 100 samples that rank series
as well as 1000 do."""

LEAST_HARMONICS = 2
"""One alone cannot rest at both ends."""


@dataclass(frozen=True, eq=False)
class ExcitationProblem:
    """One Fourier series to be found.

    Limits are one number for all joints or one per joint; position limits may be infinite.

    Attributes:
        robot: The arm; with `effort_max` its inertial parameters count as the nominal ones.
        q_min, q_max: Box the joint positions stay in [rad].
        qd_max, qdd_max: Largest speed and acceleration [rad/s, rad/s²].
        jerk_max: Largest jerk [rad/s³], None for no limit.
        effort_max: Largest torque of the nominal model [N·m], None for no limit.
        harmonics: Number of harmonics H.
        fundamental_hz: ω/2π.
        periods: Repetitions of the finished series; one period is optimised.
        objective: `condition` number to be small, or `log_det` of the information to be large.
        scaled: Condition of the regressor with its columns scaled to length 1. Makes no difference
            to `log_det`.
        rotor: Whether rotor inertias are among the parameters.
        friction: Whether Coulomb, viscous and offset torques of every joint are.
        sign_width: Of tanh(qd / width), which stands for the sign in Coulomb columns [rad/s].
        earlier: (k, b) rows that carry the information of earlier trajectories: their regressor or
            a triangle of it, columns as in `columns`. None for none. See `after`.
        collision: Distances of the arm with its load, None for no check.
        space: Distances of the flange to the faces it stays inside, None if it may go anywhere.
        clearance_m: Distance that is kept to everything, those faces included.
        centres: (m, n) poses that a search may begin about; None for any in the position box.
        base: Base parameters to be used instead of `hil.dynamics.base_parameters`.
        samples: Of the objective's grid; 0 for `SAMPLES_PER_HARMONIC` per harmonic.

    Raises:
        PlanError: Limits that no motion can keep; names all of them.
    """

    robot: RobotModel
    q_min: FloatArray | float
    q_max: FloatArray | float
    qd_max: FloatArray | float
    qdd_max: FloatArray | float
    jerk_max: FloatArray | float | None = None
    effort_max: FloatArray | float | None = None
    harmonics: int = 5
    fundamental_hz: float = 0.1
    periods: int = 1
    objective: Objective = "condition"
    scaled: bool = True
    rotor: bool = False
    friction: bool = False
    sign_width: float = 0.01
    earlier: FloatArray | None = None
    collision: Distances | None = None
    space: Distances | None = None
    clearance_m: float = 0.0
    centres: FloatArray | None = None
    base: BaseParameters | None = None
    samples: int = 0

    def __post_init__(self) -> None:
        problems = [*self._bad_limits(), *self._bad_series()]
        if problems:
            raise PlanError(
                "no excitation can be optimised: " + "; ".join(problems),
                hint="give limits that leave the arm room to move",
            )

    @cached_property
    def columns(self) -> IdentificationColumns:
        """The parameters that are to be identified."""
        return IdentificationColumns(
            self.robot,
            rotor=self.rotor,
            friction=self.friction,
            sign_width=self.sign_width,
            base=self.base,
        )

    @cached_property
    def basis(self) -> SeriesBasis:
        """The series among which one is chosen."""
        return SeriesBasis(self.harmonics, self.fundamental_hz)

    @property
    def points(self) -> int:
        """Samples of the objective's grid."""
        return self.samples or SAMPLES_PER_HARMONIC * self.harmonics

    def limit(self, name: str) -> FloatArray:
        """(n,) of one of the limits, infinite where there is none."""
        value = getattr(self, name)
        return np.broadcast_to(np.inf if value is None else value, (self.robot.n,)).astype(float)

    def regressor(self, series: FourierSeries) -> FloatArray:
        """(points·n, b) of one period of a series, its rows joint by joint."""
        grid, free = self.basis.grid(self.points), self.basis.coefficients(series).T
        return self.columns.rows(grid.q @ free, grid.qd @ free, grid.qdd @ free).transposed.T

    def information(self, *series: FourierSeries) -> FloatArray:
        """(≤ b, b) triangle R with RᵀR the information of `series` and all earlier ones."""
        parts = [self.regressor(one) for one in series]
        parts += [] if self.earlier is None else [self.earlier]
        return np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))

    def after(self, *series: FourierSeries) -> ExcitationProblem:
        """The same problem for a trajectory that is to complement `series`.

        Condition number and determinant are then those of all of them together.
        """
        return replace(self, earlier=self.information(*series))

    def _bad_limits(self) -> list[str]:
        bad = []
        low, high = self.limit("q_min"), self.limit("q_max")
        if not np.all(low < high):
            bad.append(f"the position range of {self._names(~(low < high))} is empty")
        for name in ("qd_max", "qdd_max", "jerk_max", "effort_max"):
            value = self.limit(name)
            needed = name in ("qd_max", "qdd_max")
            wrong = ~(value > 0) | (needed & ~np.isfinite(value))
            if np.any(wrong):
                bad.append(f"{name} of {self._names(wrong)} is not a positive number")
        return bad

    def _bad_series(self) -> list[str]:
        bad = []
        if self.harmonics < LEAST_HARMONICS:
            bad.append(f"{LEAST_HARMONICS} harmonics are needed for a motion from rest to rest")
        if not self.fundamental_hz > 0 or self.periods < 1:
            bad.append("fundamental_hz must be above 0 and periods at least 1")
        if self.samples and self.samples <= 4 * self.harmonics:
            bad.append(f"{self.samples} samples do not resolve {self.harmonics} harmonics")
        return bad

    def _names(self, chosen: BoolArray) -> str:
        return ", ".join(np.array(self.robot.joint_names)[chosen])


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


class Value(NamedTuple):
    """The objective at a point.

    Attributes:
        value: What is minimised, smooth.
        gradient: (n·f,) by the free coefficients.
        exact: The condition number, or −log det.
    """

    value: float
    gradient: FloatArray
    exact: float


class ValueOf:
    """The objective of a problem.

    Args:
        problem: Whose.

    Attributes:
        evaluations: So far.
        stages: Sharpness of `hil.dynamics.base.log_condition`, stage by stage.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        self._problem = problem
        self._maps = problem.basis.grid(problem.points)[:3]
        self._earlier = 0.0 if problem.earlier is None else problem.earlier.T @ problem.earlier
        self.evaluations = 0
        self.stages = (2.0, 8.0, 32.0, 128.0) if problem.objective == "condition" else (1.0,)

    def __call__(self, free: FloatArray, sharpness: float) -> Value:
        """At free coefficients (n, f)."""
        self.evaluations += 1
        rows = self._problem.columns.rows(*(part @ free.T for part in self._maps))
        G = rows.transposed @ rows.transposed.T + self._earlier
        if self._problem.objective == "condition":
            measure = log_condition(G, sharpness, self._problem.scaled)
        else:
            measure = neg_log_det(G)
            measure = measure._replace(exact=-measure.exact)
        by_motion = rows.pull_back(2.0 * measure.gradient @ rows.transposed)
        parts = [part.T @ by for part, by in zip(self._maps, by_motion, strict=True)]
        return Value(measure.value, np.sum(parts, axis=0).T.ravel(), measure.exact)


POINTS_PER_HARMONIC = 40
"""Costs 0.3 % of every limit."""

KINDS = ("q", "qd", "qdd", "jerk")


class LinearLimits:
    """|map·free − centre| ≤ half, for every kind of limit, joint and point of a grid.

    Rows are numbered by kind, sign, joint and point, and normalised: slack 1 is the whole limit.

    Args:
        problem: Whose limits.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        grid = problem.basis.grid(POINTS_PER_HARMONIC * problem.harmonics)
        self._maps = np.stack(grid)
        self._n = problem.robot.n
        low, high = problem.limit("q_min"), problem.limit("q_max")
        bounded = np.isfinite(high - low)
        centre = np.where(bounded, 0.5 * (low + high), 0.0)
        half = [np.where(bounded, 0.5 * (high - low), np.inf)]
        half += [problem.limit(name) for name in ("qd_max", "qdd_max", "jerk_max")]
        self._centre = np.stack([centre, *np.zeros((3, self._n))])
        self._half = np.stack(half) * np.cos(np.pi / POINTS_PER_HARMONIC)
        self.shape = (len(KINDS), 2, self._n, self._maps.shape[1])
        self.free_shape = (self._n, problem.basis.free)

    def slack(self, free: FloatArray) -> FloatArray:
        """(kinds, 2, n, N) share of each limit that is left, for free coefficients (n, f)."""
        way = (np.matmul(self._maps, free.T) - self._centre[:, None]) / self._half[:, None]
        way = way.transpose(0, 2, 1)
        return np.stack([1.0 - way, 1.0 + way], axis=1)

    def change(self, step: FloatArray) -> FloatArray:
        """(kinds, 2, n, N) by how much a step (n, f) of the coefficients lessens the slack."""
        way = (np.matmul(self._maps, step.T) / self._half[:, None]).transpose(0, 2, 1)
        return np.stack([way, -way], axis=1)

    def rows(self, numbers: IntArray) -> FloatArray:
        """(len(numbers), n·f) dense rows A with A·step = `change` there."""
        kind, sign, joint, point = np.unravel_index(numbers, self.shape)
        values = self._maps[kind, point] * (1.0 - 2.0 * sign)[:, None]
        out = np.zeros((len(numbers), self._n, self._maps.shape[2]))
        out[np.arange(len(numbers)), joint] = values / self._half[kind, joint][:, None]
        return out.reshape(len(numbers), self._n * self._maps.shape[2])

    def unit(self) -> FloatArray:
        """(n·f,) size of every coefficient that alone reaches a limit; of the centre 1 rad."""
        reached = np.abs(self._maps).max(axis=1)[:, None] / self._half[:, :, None]
        out = 1.0 / np.maximum(reached.max(axis=0), 1e-12)
        out[:, 0] = 1.0
        return np.asarray(out.ravel())

    def largest_scale(self, free: FloatArray) -> FloatArray:
        """(n,) by which the motion of each joint about its centre can be multiplied."""
        moved = free.copy()
        moved[:, 0] = 0.0
        way = np.matmul(self._maps, moved.T)
        reached = np.abs(way[1:]).max(axis=1) / self._half[1:]
        # Of the range only its width counts: the centre is chosen afterwards.
        width = 0.5 * (way[0].max(axis=0) - way[0].min(axis=0)) / self._half[0]
        return np.asarray(1.0 / np.maximum(reached.max(axis=0), width))

    def centres(self, free: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least and greatest q₀ (n,) that keep a motion in the box; ±π where there is none."""
        moved = free.copy()
        moved[:, 0] = 0.0
        q = self._maps[0] @ moved.T
        half = np.where(np.isfinite(self._half[0]), self._half[0], np.pi + np.abs(q).max(axis=0))
        low, high = self._centre[0] - half - q.min(axis=0), self._centre[0] + half - q.max(axis=0)
        return np.minimum(low, high), np.maximum(low, high)


def peaks(slack: FloatArray, below: float) -> IntArray:
    """Numbers of the rows whose slack is below a value and least among their neighbours in time."""
    before, after = np.roll(slack, 1, axis=-1), np.roll(slack, -1, axis=-1)
    return np.flatnonzero((slack < below) & (slack <= before) & (slack <= after))


DISTANCE_SCALE_M = 0.1
"""An excess of 1 is so much too close, or all of a torque limit too much."""

DIFFERENCE_RAD = 1e-6
TORQUES_AT_ONCE = 500

RESERVE = 0.005
"""Taken off every limit from the first: for what is exceeded between the points, and because steps
come near to limits like these but seldom upon them."""

TOLERATED = 0.5 * RESERVE
"""Excess over a limit less its reserve that counts as none."""


class MotionSamples(NamedTuple):
    """Samples of a motion, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


def torques(robot: RobotModel, at: MotionSamples) -> FloatArray:
    """(N, n) of the nominal model, in blocks: to compile for many samples would take longer."""
    blocks = zip(*(np.array_split(x, 1 + len(x) // TORQUES_AT_ONCE) for x in at), strict=True)
    return np.concatenate([robot.inverse_dynamics(*block) for block in blocks])


class MotionLimit(Protocol):
    """A limit on every sample of a motion by itself."""

    def excess(self, at: MotionSamples) -> FloatArray:
        """(R, N) by how much each of its rows is exceeded at each sample; negative where not."""

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """Derivatives of the excess of row `row[k]` by sample k, each (N, n)."""

    def complaint(self, at: MotionSamples) -> str:
        """What is worst about a motion."""


class EffortLimit:
    """Torques of the nominal model within limits: rows are upper limits, then lower ones."""

    def __init__(self, problem: ExcitationProblem) -> None:
        self._robot, self._most = problem.robot, problem.limit("effort_max")

    def excess(self, at: MotionSamples) -> FloatArray:
        """(2n, N) share of the limit."""
        share = (torques(self._robot, at) / self._most).T
        return np.concatenate([share, -share]) - 1.0

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """From the derivatives of inverse dynamics."""
        sign, joint = np.divmod(row, self._robot.n)
        factor = ((1.0 - 2.0 * sign) / self._most[joint])[:, None]
        samples = np.arange(len(row))
        parts = self._robot.inverse_dynamics_derivatives(*at)
        return MotionSamples(*(factor * part[samples, joint] for part in parts))

    def complaint(self, at: MotionSamples) -> str:
        """The joint that lacks most."""
        excess = self.excess(at)
        joint = int(np.unravel_index(excess.argmax(), excess.shape)[0]) % self._robot.n
        needed = self._most[joint] * (1.0 + excess.max())
        return (
            f"{self._robot.joint_names[joint]} needs {needed:.3g} N·m where "
            f"{self._most[joint]:.3g} are allowed"
        )


class DistanceLimit:
    """A distance kept between all bodies, or to all faces of a space: a row for each pair.

    Args:
        model: Gives the distances.
        kept_m: The least allowed.
    """

    def __init__(self, model: Distances, kept_m: float) -> None:
        self._model, self._kept = model, kept_m

    def excess(self, at: MotionSamples) -> FloatArray:
        """(R, N) of `DISTANCE_SCALE_M`."""
        return (self._kept - self._model.distances(at.q)) / DISTANCE_SCALE_M

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """By central differences, all different samples and joints in one call."""
        q, number = np.unique(at.q, axis=0, return_inverse=True)
        N, n = q.shape
        steps = DIFFERENCE_RAD * np.stack([np.eye(n), -np.eye(n)])
        moved = (q + steps[:, :, None]).reshape(-1, n)
        distances = self._model.distances(moved).reshape(len(self._model.names), 2, n, N)
        distances = distances[row, :, :, number]
        slope = (distances[:, 1] - distances[:, 0]) / (2.0 * DIFFERENCE_RAD * DISTANCE_SCALE_M)
        return MotionSamples(slope, np.zeros_like(slope), np.zeros_like(slope))

    def closest(self, at: MotionSamples) -> tuple[float, tuple[str, str]]:
        """Least distance beyond the one that is kept [m], and between what."""
        distances = self._model.distances(at.q)
        row = int(np.unravel_index(distances.argmin(), distances.shape)[0])
        return float(distances.min()) - self._kept, self._model.names[row]

    def complaint(self, at: MotionSamples) -> str:
        """The bodies that are closest."""
        beyond, bodies = self.closest(at)
        return (
            f"{' and '.join(bodies)} come as near as {1e3 * (beyond + self._kept):.0f} mm where "
            f"{1e3 * self._kept:.0f} mm are kept"
        )


class SpaceLimit(DistanceLimit):
    """The flange inside its space."""

    def complaint(self, at: MotionSamples) -> str:
        """Return the face that is furthest overstepped."""
        beyond, (point, face) = self.closest(at)
        depth = beyond + self._kept
        if depth < 0:
            return f"the {point} goes {-1e3 * depth:.0f} mm beyond {face}"
        return (
            f"the {point} stays only {1e3 * depth:.0f} mm inside {face} where "
            f"{1e3 * self._kept:.0f} mm are kept"
        )


class MotionLimits:
    """All limits of a problem that are not linear, on a grid of one period.

    Attributes:
        limits: Those there are.
        reserve: Taken off each, in its own scale.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        self.limits: list[MotionLimit] = []
        if problem.effort_max is not None:
            self.limits.append(EffortLimit(problem))
        if problem.collision is not None:
            self.limits.append(DistanceLimit(problem.collision, problem.clearance_m))
        if problem.space is not None:
            self.limits.append(SpaceLimit(problem.space, problem.clearance_m))
        self.reserve = np.full(len(self.limits), RESERVE)
        self._basis = problem.basis
        self._points = POINTS_PER_HARMONIC * problem.harmonics
        self._maps = np.stack(problem.basis.grid(self._points)[:3])

    def motion(self, free: FloatArray, denser: int = 1) -> MotionSamples:
        """Samples of the motion with free coefficients (n, f)."""
        maps = self._maps
        if denser > 1:
            maps = np.stack(self._basis.grid(denser * self._points)[:3])
        return MotionSamples(*np.matmul(maps, free.T))

    def excess(self, free: FloatArray) -> FloatArray:
        """(R, N) of all limits, their reserves added."""
        at = self.motion(free)
        parts = [
            limit.excess(at) + reserve
            for limit, reserve in zip(self.limits, self.reserve, strict=True)
        ]
        return np.concatenate(parts) if parts else np.empty((0, self._points))

    def rows(self, free: FloatArray, numbers: IntArray) -> FloatArray:
        """(len(numbers), n·f) derivatives of some of `excess`, numbered along its rows."""
        at = self.motion(free)
        row, sample = np.divmod(numbers, self._points)
        out = np.empty((len(numbers), free.size))
        first = 0
        for limit in self.limits:
            last = first + len(limit.excess(MotionSamples(*(x[:1] for x in at))))
            mine = np.flatnonzero((row >= first) & (row < last))
            some = MotionSamples(*(x[sample[mine]] for x in at))
            by = limit.gradient(some, row[mine] - first)
            terms = [
                g[:, :, None] * m[sample[mine], None] for g, m in zip(by, self._maps, strict=True)
            ]
            out[mine] = sum(terms).reshape(len(mine), free.size)
            first = last
        return out

    def exceeded(self, free: FloatArray, denser: int) -> FloatArray:
        """(limits,) largest excess on a denser grid, without reserve."""
        at = self.motion(free, denser)
        return np.array([limit.excess(at).max() for limit in self.limits])

    def complaint(self, free: FloatArray) -> str:
        """What is worst about a motion that exceeds a limit."""
        at = self.motion(free)
        said = [limit.complaint(at) for limit in self.limits if limit.excess(at).max() > 0]
        return "; ".join(said)


DENSER = 10
"""Points of the grid that margins are taken on, for each of the limits' own."""

ROUNDING = 1e-9
"""Excess that counts as none."""


@dataclass(frozen=True, slots=True, eq=False)
class Margins:
    """What a series leaves of every limit, on a dense grid; negative where one is exceeded.

    Attributes:
        position_rad: (n,) to the nearer end of the position box.
        velocity, acceleration: (n,) share of the limit that is left.
        jerk, effort: (n,) the same, None where there is no limit.
        clearance_m: Distance beyond what is kept, None where it is not checked.
        bodies: Between which two bodies that is.
        space_m: Distance of the flange to the faces of its space beyond what is kept, None if it
            may go anywhere.
    """

    position_rad: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray | None = None
    effort: FloatArray | None = None
    clearance_m: float | None = None
    bodies: tuple[str, str] | None = None
    space_m: float | None = None

    @property
    def feasible(self) -> bool:
        """Whether no limit is exceeded."""
        shares = (self.velocity, self.acceleration, self.jerk, self.effort, self.position_rad)
        least = min(float(np.min(share)) for share in shares if share is not None)
        return min(least, self.clearance_m or 0.0, self.space_m or 0.0) >= -ROUNDING

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        out: dict[str, Any] = {}
        for name in ("position_rad", "velocity", "acceleration", "jerk", "effort"):
            value = getattr(self, name)
            out[name] = None if value is None else [float(x) for x in value]
        bodies = None if self.bodies is None else list(self.bodies)
        distances = {"clearance_m": self.clearance_m, "space_m": self.space_m}
        return out | distances | {"bodies": bodies}


def margins_of(problem: ExcitationProblem, series: FourierSeries, points: int = 0) -> Margins:
    """The margins of any series to a problem's limits.

    Args:
        problem: Whose limits.
        series: The motion.
        points: Of the grid over one period; 0 for `DENSER` times the limits' own.
    """
    points = points or DENSER * POINTS_PER_HARMONIC * problem.harmonics
    grid, free = problem.basis.grid(points), problem.basis.coefficients(series).T
    q, qd, qdd, jerk = (part @ free for part in grid)
    motion = MotionSamples(q, qd, qdd)
    kept, bodies, inside = None, None, None
    if problem.collision is not None:
        kept, bodies = DistanceLimit(problem.collision, problem.clearance_m).closest(motion)
    if problem.space is not None:
        inside, _ = DistanceLimit(problem.space, problem.clearance_m).closest(motion)
    effort = None
    if problem.effort_max is not None:
        effort = _left(torques(problem.robot, motion), problem.limit("effort_max"))
    return Margins(
        position_rad=np.minimum(
            q.min(axis=0) - problem.limit("q_min"), problem.limit("q_max") - q.max(axis=0)
        ),
        velocity=_left(qd, problem.limit("qd_max")),
        acceleration=_left(qdd, problem.limit("qdd_max")),
        jerk=None if problem.jerk_max is None else _left(jerk, problem.limit("jerk_max")),
        effort=effort,
        clearance_m=kept,
        bodies=bodies,
        space_m=inside,
    )


def _left(values: FloatArray, limit: FloatArray) -> FloatArray:
    return np.asarray(1.0 - np.abs(values).max(axis=0) / limit)
