"""Optimisation problem of a Fourier excitation trajectory: series, objective and limits.

The free coefficients of a motion form an array (n, f). The conditions for rest at both ends have a
null space (`SeriesBasis`), which leaves f = 2H − 1 free coefficients per joint. The objective and
all limits are functions of the free coefficients, with exact derivatives:

- `ValueOf` is the objective: condition number or determinant of the base regressor, which includes
  the rows of earlier trajectories;
- `LinearLimits` limits position, speed, acceleration and jerk at all times, not only at the points
  of a grid. A trigonometric polynomial of degree H, sampled at m·H points, exceeds its largest
  absolute sample by a factor of at most 1/cos(π/m) (Ehlich and Zeller 1964). Every linear limit is
  reduced by the factor 1/cos(π/m), so that it holds between the points of the grid;
- `MotionLimits` limits the torques of the nominal model, the distances between bodies, and the
  distances of the flange to the faces of its space.

`margins_of` computes the margins of a finished series to each limit, on a grid ten times denser.
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
"""Number of samples per harmonic on the grid of the objective: 100 samples for five harmonics rank
series as well as 1000 samples do.
"""

LEAST_HARMONICS = 2
"""Minimum number of harmonics: a series with one harmonic cannot be at rest at both ends."""


@dataclass(frozen=True, eq=False)
class ExcitationProblem:
    """Optimisation problem of one Fourier series.

    Each limit is one number for all joints or an array with one number per joint. Position limits
    may be infinite.

    Attributes:
        robot: Robot model; its inertial parameters are the nominal ones if `effort_max` is set.
        q_min, q_max: Lower and upper limits of the joint positions [rad].
        qd_max, qdd_max: Maximum speed and acceleration [rad/s, rad/s²].
        jerk_max: Maximum jerk [rad/s³], None for no limit.
        effort_max: Maximum torque of the nominal model [N·m], None for no limit.
        harmonics: Number of harmonics H of the series.
        fundamental_hz: Fundamental frequency ω/2π [Hz].
        periods: Number of periods of the finished series; only one period is optimised.
        objective: `condition` to minimise the condition number, `log_det` to maximise the
            determinant of the information matrix.
        scaled: Flag; if true, the condition number is computed with all regressor columns scaled to
            length 1. The `log_det` objective does not depend on the scaling.
        rotor: Flag; if true, rotor inertias are among the parameters.
        friction: Flag; if true, Coulomb friction, viscous friction and torque offset of every joint
            are among the parameters.
        sign_width: Width of tanh(qd / width), the smooth sign function in Coulomb columns [rad/s].
        earlier: (k, b) rows with the information of earlier trajectories: their regressor or its
            triangle R, with the same columns as `columns`. `earlier` is None if there are no
            earlier trajectories. See `after`.
        collision: Distances between the bodies of the arm, its payload and the surroundings; None
            for no collision check.
        space: Distances of the flange to the faces of its space; None if the flange is not
            confined.
        clearance_m: Minimum distance to all bodies and to the faces of `space` [m].
        centres: (m, n) poses from which the centres of the random starts are taken; None for random
            centres within the position limits.
        base: Base parameters to use instead of those of `hil.dynamics.base_parameters`.
        samples: Number of samples on the grid of the objective; 0 for `SAMPLES_PER_HARMONIC` per
            harmonic.

    Raises:
        PlanError: No motion can satisfy the limits of the problem; the message lists every invalid
            limit.
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
                hint="widen the limits, so that the arm can move",
            )

    @cached_property
    def columns(self) -> IdentificationColumns:
        """Columns of the regressor, one per identified parameter."""
        return IdentificationColumns(
            self.robot,
            rotor=self.rotor,
            friction=self.friction,
            sign_width=self.sign_width,
            base=self.base,
        )

    @cached_property
    def basis(self) -> SeriesBasis:
        """Basis of all series with the harmonics and fundamental frequency of the problem."""
        return SeriesBasis(self.harmonics, self.fundamental_hz)

    @property
    def points(self) -> int:
        """Number of samples on the grid of the objective."""
        return self.samples or SAMPLES_PER_HARMONIC * self.harmonics

    def limit(self, name: str) -> FloatArray:
        """Return the limit `name` of each joint, (n,); infinite if there is no such limit."""
        value = getattr(self, name)
        return np.broadcast_to(np.inf if value is None else value, (self.robot.n,)).astype(float)

    def regressor(self, series: FourierSeries) -> FloatArray:
        """Return the regressor (points·n, b) of one period of a series, rows grouped by joint."""
        grid, free = self.basis.grid(self.points), self.basis.coefficients(series).T
        return self.columns.rows(grid.q @ free, grid.qd @ free, grid.qdd @ free).transposed.T

    def information(self, *series: FourierSeries) -> FloatArray:
        """Return a triangle R (≤ b, b) of the regressor of `series` and all earlier series.

        The product RᵀR is the information matrix of `series` and all earlier series.
        """
        parts = [self.regressor(one) for one in series]
        parts += [] if self.earlier is None else [self.earlier]
        return np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))

    def after(self, *series: FourierSeries) -> ExcitationProblem:
        """Return the same problem for a trajectory that complements `series`.

        The condition number and determinant of the returned problem are those of all trajectories
        together.
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
            bad.append(
                f"at least {LEAST_HARMONICS} harmonics are needed for a motion that begins and "
                "ends at standstill"
            )
        if not self.fundamental_hz > 0 or self.periods < 1:
            bad.append("fundamental_hz must be above 0 and periods at least 1")
        if self.samples and self.samples <= 4 * self.harmonics:
            bad.append(f"{self.samples} samples do not resolve {self.harmonics} harmonics")
        return bad

    def _names(self, chosen: BoolArray) -> str:
        return ", ".join(np.array(self.robot.joint_names)[chosen])


class Grid(NamedTuple):
    """Matrices (N, f) that map free coefficients (f, n) to samples on a grid of one period.

    The matrix `jerk` maps the free coefficients to the derivative of `qdd` [rad/s³].
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    jerk: FloatArray


@dataclass(frozen=True)
class SeriesBasis:
    """Basis of the Fourier series (eq. 29, PINN paper) with Σ aᵢ = 0 and Σ i·bᵢ = 0 per joint.

    Each joint has 2H + 1 coefficients, of which 2H − 1 are free: the centre q₀ [rad], then the
    coordinates of a and of b in the null spaces of the two conditions [rad/s]. The free
    coefficients of an arm form an array (n, 2H − 1).

    Attributes:
        harmonics: Number of harmonics H, at least 2.
        fundamental_hz: Fundamental frequency ω/2π [Hz].
    """

    harmonics: int
    fundamental_hz: float

    @property
    def free(self) -> int:
        """Number of free coefficients of a joint."""
        return 2 * self.harmonics - 1

    def grid(self, points: int) -> Grid:
        """Return the grid at times 0, 1/points, … of one period, without the end of the period."""
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
        """Return the motion that has the free coefficients (n, f)."""
        (A, B), split = self._rest, self.harmonics
        a, b = _rows(free[:, 1:split] @ A.T), _rows(free[:, split:] @ B.T)
        return FourierSeries(tuple(map(float, free[:, 0])), a, b, self.fundamental_hz, periods)

    def coefficients(self, series: FourierSeries) -> FloatArray:
        """Return the free coefficients (n, f) of a series.

        A series that is not at rest at its ends is first projected onto the basis.
        """
        A, B = self._rest
        return np.column_stack([series.q0, np.array(series.a) @ A, np.array(series.b) @ B])

    @property
    def _order(self) -> FloatArray:
        return np.arange(1.0, self.harmonics + 1)

    @property
    def _rest(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal bases (H, H − 1) of the coefficients a and b with rest at both ends."""
        conditions = np.ones((1, self.harmonics)), self._order[None]
        A, B = (scipy.linalg.null_space(row) for row in conditions)
        return A, B


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)


class Value(NamedTuple):
    """Value of the objective at a point.

    Attributes:
        value: Smooth value of the objective, which is minimised.
        gradient: (n·f,) derivatives of `value` by the free coefficients.
        exact: Exact value of the objective: condition number, or −log det.
    """

    value: float
    gradient: FloatArray
    exact: float


class ValueOf:
    """Objective function of an excitation problem.

    Args:
        problem: Problem that defines the objective.

    Attributes:
        evaluations: Number of evaluations of the objective so far.
        stages: Sharpness of `hil.dynamics.base.log_condition` in each stage of the optimisation.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        self._problem = problem
        self._maps = problem.basis.grid(problem.points)[:3]
        self._earlier = 0.0 if problem.earlier is None else problem.earlier.T @ problem.earlier
        self.evaluations = 0
        self.stages = (2.0, 8.0, 32.0, 128.0) if problem.objective == "condition" else (1.0,)

    def __call__(self, free: FloatArray, sharpness: float) -> Value:
        """Return the value of the objective at the free coefficients (n, f)."""
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
"""Number of grid points per harmonic on which limits are checked; the reduction for the gaps
between the points costs 0.3 % of every limit.
"""

KINDS = ("q", "qd", "qdd", "jerk")


class LinearLimits:
    """Linear limits |map·free − centre| ≤ half, for every quantity, joint and grid point.

    Rows of the linear limits are numbered by quantity, sign, joint and grid point. All rows of the
    linear limits are normalised: a slack of 1 is the whole limit.

    Args:
        problem: Problem that defines the limits.
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
        """Return the unused share of each limit at free coefficients (n, f); (kinds, 2, n, N)."""
        way = (np.matmul(self._maps, free.T) - self._centre[:, None]) / self._half[:, None]
        way = way.transpose(0, 2, 1)
        return np.stack([1.0 - way, 1.0 + way], axis=1)

    def change(self, step: FloatArray) -> FloatArray:
        """Return the decrease of the slack by a step (n, f) of coefficients; (kinds, 2, n, N)."""
        way = (np.matmul(self._maps, step.T) / self._half[:, None]).transpose(0, 2, 1)
        return np.stack([way, -way], axis=1)

    def rows(self, numbers: IntArray) -> FloatArray:
        """Return dense rows A, (len(numbers), n·f), with A·step equal to `change` at `numbers`."""
        kind, sign, joint, point = np.unravel_index(numbers, self.shape)
        values = self._maps[kind, point] * (1.0 - 2.0 * sign)[:, None]
        out = np.zeros((len(numbers), self._n, self._maps.shape[2]))
        out[np.arange(len(numbers)), joint] = values / self._half[kind, joint][:, None]
        return out.reshape(len(numbers), self._n * self._maps.shape[2])

    def unit(self) -> FloatArray:
        """Return for each coefficient, (n·f,), the size at which it alone reaches a limit.

        The size of the coefficient of a centre is set to 1 rad.
        """
        reached = np.abs(self._maps).max(axis=1)[:, None] / self._half[:, :, None]
        out = 1.0 / np.maximum(reached.max(axis=0), 1e-12)
        out[:, 0] = 1.0
        return np.asarray(out.ravel())

    def largest_scale(self, free: FloatArray) -> FloatArray:
        """Return for each joint, (n,), the largest factor by which its motion can be scaled."""
        moved = free.copy()
        moved[:, 0] = 0.0
        way = np.matmul(self._maps, moved.T)
        reached = np.abs(way[1:]).max(axis=1) / self._half[1:]
        # Only the width of the position range matters: the centre is chosen afterwards.
        width = 0.5 * (way[0].max(axis=0) - way[0].min(axis=0)) / self._half[0]
        return np.asarray(1.0 / np.maximum(reached.max(axis=0), width))

    def centres(self, free: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the smallest and largest centre q₀ (n,) of a motion within position limits.

        Joints without position limits get the range ±π.
        """
        moved = free.copy()
        moved[:, 0] = 0.0
        q = self._maps[0] @ moved.T
        half = np.where(np.isfinite(self._half[0]), self._half[0], np.pi + np.abs(q).max(axis=0))
        low, high = self._centre[0] - half - q.min(axis=0), self._centre[0] + half - q.max(axis=0)
        return np.minimum(low, high), np.maximum(low, high)


def peaks(slack: FloatArray, below: float) -> IntArray:
    """Return the numbers of the rows whose slack is below `below` and a local minimum in time."""
    before, after = np.roll(slack, 1, axis=-1), np.roll(slack, -1, axis=-1)
    return np.flatnonzero((slack < below) & (slack <= before) & (slack <= after))


DISTANCE_SCALE_M = 0.1
"""Missing distance [m] that counts as an excess of 1; a torque of twice its limit also counts as an
excess of 1.
"""

DIFFERENCE_RAD = 1e-6
TORQUES_AT_ONCE = 500

RESERVE = 0.005
"""Reserve: excess by which every nonlinear limit is tightened from the start. The reserve covers
excesses between the grid points, and steps that approach nonlinear limits without reaching them
exactly.
"""

TOLERATED = 0.5 * RESERVE
"""Maximum excess over a limit, reduced by its reserve, that is treated as zero."""


class MotionSamples(NamedTuple):
    """Samples of position, velocity and acceleration of a motion, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


def torques(robot: RobotModel, at: MotionSamples) -> FloatArray:
    """Return the joint torques of the nominal model (N, n) [N·m].

    The torques are computed in blocks of samples, because compiling for many samples would take
    longer.
    """
    blocks = zip(*(np.array_split(x, 1 + len(x) // TORQUES_AT_ONCE) for x in at), strict=True)
    return np.concatenate([robot.inverse_dynamics(*block) for block in blocks])


class MotionLimit(Protocol):
    """Limit that applies to every sample of a motion separately."""

    def excess(self, at: MotionSamples) -> FloatArray:
        """Return the excess of each row at each sample, (R, N); negative within the limit."""

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """Return the derivatives of the excess of row `row[k]` at sample k, each (N, n)."""

    def complaint(self, at: MotionSamples) -> str:
        """Return a text that describes the worst violation of a motion."""


class EffortLimit:
    """Torque limits of the nominal model; one row per upper limit, then one per lower limit."""

    def __init__(self, problem: ExcitationProblem) -> None:
        self._robot, self._most = problem.robot, problem.limit("effort_max")

    def excess(self, at: MotionSamples) -> FloatArray:
        """Return the excess over the torque limit as a share of this limit, (2n, N)."""
        share = (torques(self._robot, at) / self._most).T
        return np.concatenate([share, -share]) - 1.0

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """Return the derivatives of the torque excess, from the derivatives of inverse dynamics."""
        sign, joint = np.divmod(row, self._robot.n)
        factor = ((1.0 - 2.0 * sign) / self._most[joint])[:, None]
        samples = np.arange(len(row))
        parts = self._robot.inverse_dynamics_derivatives(*at)
        return MotionSamples(*(factor * part[samples, joint] for part in parts))

    def complaint(self, at: MotionSamples) -> str:
        """Return a text that names the joint with the largest torque excess."""
        excess = self.excess(at)
        joint = int(np.unravel_index(excess.argmax(), excess.shape)[0]) % self._robot.n
        needed = self._most[joint] * (1.0 + excess.max())
        return (
            f"{self._robot.joint_names[joint]} needs {needed:.3g} N·m, only "
            f"{self._most[joint]:.3g} N·m are allowed"
        )


class DistanceLimit:
    """Minimum distance between all bodies, or to all faces of a space; one row per pair.

    Args:
        model: Model that computes the distances.
        kept_m: Minimum distance of each pair [m].
    """

    def __init__(self, model: Distances, kept_m: float) -> None:
        self._model, self._kept = model, kept_m

    def excess(self, at: MotionSamples) -> FloatArray:
        """Return the missing distance in units of `DISTANCE_SCALE_M`, (R, N)."""
        return (self._kept - self._model.distances(at.q)) / DISTANCE_SCALE_M

    def gradient(self, at: MotionSamples, row: IntArray) -> MotionSamples:
        """Return central differences of the excess, computed for all samples in one call."""
        q, number = np.unique(at.q, axis=0, return_inverse=True)
        N, n = q.shape
        steps = DIFFERENCE_RAD * np.stack([np.eye(n), -np.eye(n)])
        moved = (q + steps[:, :, None]).reshape(-1, n)
        distances = self._model.distances(moved).reshape(len(self._model.names), 2, n, N)
        distances = distances[row, :, :, number]
        slope = (distances[:, 1] - distances[:, 0]) / (2.0 * DIFFERENCE_RAD * DISTANCE_SCALE_M)
        return MotionSamples(slope, np.zeros_like(slope), np.zeros_like(slope))

    def closest(self, at: MotionSamples) -> tuple[float, tuple[str, str]]:
        """Return the smallest distance minus the required one [m], and the names of the pair."""
        distances = self._model.distances(at.q)
        row = int(np.unravel_index(distances.argmin(), distances.shape)[0])
        return float(distances.min()) - self._kept, self._model.names[row]

    def complaint(self, at: MotionSamples) -> str:
        """Return a text that names the two closest bodies."""
        beyond, bodies = self.closest(at)
        return (
            f"{' and '.join(bodies)} come within {1e3 * (beyond + self._kept):.0f} mm of each "
            f"other, {1e3 * self._kept:.0f} mm are required"
        )


class SpaceLimit(DistanceLimit):
    """Minimum distance of the flange to the faces of its space, measured inwards from the faces."""

    def complaint(self, at: MotionSamples) -> str:
        """Return a text that names the face with the largest violation by the flange."""
        beyond, (point, face) = self.closest(at)
        depth = beyond + self._kept
        if depth < 0:
            return f"the {point} goes {-1e3 * depth:.0f} mm beyond {face}"
        return (
            f"the {point} stays only {1e3 * depth:.0f} mm inside {face}, "
            f"{1e3 * self._kept:.0f} mm are required"
        )


class MotionLimits:
    """All nonlinear limits of an excitation problem, on a grid of one period.

    Attributes:
        limits: Nonlinear limits that the problem defines.
        reserve: Excess by which each limit is tightened, in the scale of that limit.
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
        """Return samples of the motion that has the free coefficients (n, f).

        The grid of the samples has `denser` times as many points as the grid of the limits.
        """
        maps = self._maps
        if denser > 1:
            maps = np.stack(self._basis.grid(denser * self._points)[:3])
        return MotionSamples(*np.matmul(maps, free.T))

    def excess(self, free: FloatArray) -> FloatArray:
        """Return the excess of all limits with their reserves added, (R, N)."""
        at = self.motion(free)
        parts = [
            limit.excess(at) + reserve
            for limit, reserve in zip(self.limits, self.reserve, strict=True)
        ]
        return np.concatenate(parts) if parts else np.empty((0, self._points))

    def rows(self, free: FloatArray, numbers: IntArray) -> FloatArray:
        """Return the derivatives of selected elements of `excess`, (len(numbers), n·f).

        Args:
            free: Free coefficients (n, f).
            numbers: Flat indices of the selected elements of `excess`.
        """
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
        """Return the largest excess over each limit on a denser grid, without reserve."""
        at = self.motion(free, denser)
        return np.array([limit.excess(at).max() for limit in self.limits])

    def complaint(self, free: FloatArray) -> str:
        """Return a text that describes the worst violation of each exceeded limit."""
        at = self.motion(free)
        said = [limit.complaint(at) for limit in self.limits if limit.excess(at).max() > 0]
        return "; ".join(said)


DENSER = 10
"""Ratio between the number of grid points for margins and the number of grid points for limits."""

ROUNDING = 1e-9
"""Maximum excess that is treated as zero because of rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Margins:
    """Margins of a series to every limit, on a dense grid; negative beyond a limit.

    Attributes:
        position_rad: (n,) distance to the nearer position limit.
        velocity, acceleration: (n,) unused share of the velocity and acceleration limits.
        jerk, effort: (n,) unused share of the jerk and torque limits, None if there is no such
            limit.
        clearance_m: Smallest distance between bodies minus the required distance [m], None if
            distances are not checked.
        bodies: Names of the two bodies with the smallest distance.
        space_m: Smallest distance of the flange to the faces of its space minus the required
            distance [m], None if the flange is not confined.
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
        """Whether the series exceeds no limit."""
        shares = (self.velocity, self.acceleration, self.jerk, self.effort, self.position_rad)
        least = min(float(np.min(share)) for share in shares if share is not None)
        return min(least, self.clearance_m or 0.0, self.space_m or 0.0) >= -ROUNDING

    def to_dict(self) -> dict[str, Any]:
        """Return the margins as a JSON object."""
        out: dict[str, Any] = {}
        for name in ("position_rad", "velocity", "acceleration", "jerk", "effort"):
            value = getattr(self, name)
            out[name] = None if value is None else [float(x) for x in value]
        bodies = None if self.bodies is None else list(self.bodies)
        distances = {"clearance_m": self.clearance_m, "space_m": self.space_m}
        return out | distances | {"bodies": bodies}


def margins_of(problem: ExcitationProblem, series: FourierSeries, points: int = 0) -> Margins:
    """Compute the margins of a series to the limits of a problem.

    Args:
        problem: Problem that defines the limits.
        series: Fourier series whose margins are computed.
        points: Number of grid points of one period; 0 for `DENSER` times the grid of the limits.
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
