"""Information of trajectories about robot parameters, and margins of trajectories to every limit.

`Information` is the triangle R of a regressor, from which condition numbers and standard errors
follow. `appraise` computes information and margins from the finished motions at the command rate.
Results of the search that found the motions do not enter the appraisal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg

from hil.core import FloatArray
from hil.dynamics import base_parameters
from hil.excitation.motion import FourierSeries, Samples
from hil.excitation.program import Setting
from hil.excitation.workspace import Workspace

if TYPE_CHECKING:
    from hil.dynamics import RobotModel


REGRESSOR_ROWS = 1000
"""Approximate maximum number of samples of a trajectory in its regressor."""


class Limits(NamedTuple):
    """Limits of trajectories, each (n,); infinite if there is no limit.

    Units of the limits: `q_min` and `q_max` [rad], `velocity` [rad/s], `acceleration` [rad/s²],
    `jerk` [rad/s³], `effort` [N·m], `clearance_m` [m].
    """

    q_min: FloatArray
    q_max: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    effort: FloatArray
    clearance_m: float


class Closest(NamedTuple):
    """Smallest distance [m], names of the two closest bodies, and time of the minimum [s]."""

    distance_m: float
    bodies: tuple[str, str]
    at_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Triangle R of a regressor W = Q·R; R contains the same information about parameters as W.

    Attributes:
        triangle: (b, b) upper triangle.
        names: (b,) names of the parameters.
    """

    triangle: FloatArray
    names: tuple[str, ...]

    def with_more(self, other: Information) -> Information:
        """Return the combined information of this and the other regressor."""
        stacked = np.vstack([self.triangle, other.triangle])
        return Information(_triangle(stacked), self.names)

    @property
    def condition_raw(self) -> float:
        """Condition number of the unscaled regressor, in mixed units."""
        return float(np.linalg.cond(self.triangle))

    @property
    def condition_scaled(self) -> float:
        """Condition number with every column scaled to length 1."""
        values = self.singular_values
        return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")

    @property
    def singular_values(self) -> FloatArray:
        """Singular values (b,) of the regressor with columns scaled to length 1, largest first."""
        length = np.linalg.norm(self.triangle, axis=0)
        scaled = self.triangle / np.where(length > 0, length, 1.0)
        return np.asarray(np.linalg.svd(scaled, compute_uv=False))

    @property
    def standard_errors(self) -> FloatArray:
        """Standard errors (b,) of a least-squares fit, per unit of noise in every effort.

        All standard errors are infinite if the samples do not determine every parameter.
        """
        if np.any(np.diag(self.triangle) == 0):
            return np.full(len(self.names), np.inf)
        inverse = scipy.linalg.solve_triangular(self.triangle, np.eye(len(self.names)))
        return np.asarray(np.linalg.norm(inverse, axis=1))


def _triangle(W: FloatArray) -> FloatArray:
    """Return the triangle (b, b) of a regressor (M, b), padded with zero rows if M < b."""
    rows: FloatArray = scipy.linalg.qr(W, mode="r")[0][: W.shape[1]]
    return np.pad(rows, ((0, W.shape[1] - len(rows)), (0, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Appraisal of one trajectory.

    Attributes:
        series: Motion of the trajectory.
        samples: Set-points of the trajectory at the command rate.
        jerk: (N, n) jerk [rad/s³].
        effort: (L, N, n) torque of the nominal rigid-body model with each load [N·m].
        clearance: (N,) smallest distance between bodies [m].
        alone: Information of this trajectory alone.
        jointly: Information of this trajectory together with the earlier ones.
        closest: Smallest distance of this trajectory, with bodies and time.
    """

    series: FourierSeries
    samples: Samples
    jerk: FloatArray
    effort: FloatArray
    clearance: FloatArray
    alone: Information
    jointly: Information
    closest: Closest


@dataclass(frozen=True, slots=True, eq=False)
class Appraisal:
    """Appraisal of all trajectories of a program.

    Attributes:
        joint_names: (n,) names of the joints.
        limits: Limits of the trajectories.
        trajectories: Appraised trajectories of the program, in order.
    """

    joint_names: tuple[str, ...]
    limits: Limits
    trajectories: tuple[Trajectory, ...]

    @property
    def jointly(self) -> Information:
        """Information of all trajectories together."""
        return self.trajectories[-1].jointly

    @property
    def closest(self) -> tuple[int, Closest]:
        """Number of the trajectory with the smallest distance, and that smallest distance."""
        closest = [trajectory.closest for trajectory in self.trajectories]
        number = min(range(len(closest)), key=lambda i: closest[i].distance_m)
        return number, closest[number]

    @property
    def margins(self) -> dict[str, FloatArray]:
        """Smallest margins (n,) over all trajectories, by name and unit of the limit."""
        each = [margins_of(trajectory, self.limits) for trajectory in self.trajectories]
        return {name: np.min([margins[name] for margins in each], axis=0) for name in each[0]}


def margins_of(trajectory: Trajectory, limits: Limits) -> dict[str, FloatArray]:
    """Return the margins (n,) of a trajectory by name and unit; negative beyond a limit."""
    samples = trajectory.samples
    q = np.vstack([trajectory.series.q_start, samples.q])
    return {
        "position_rad": np.minimum(q.min(axis=0) - limits.q_min, limits.q_max - q.max(axis=0)),
        "velocity_rad_s": limits.velocity - np.abs(samples.qd).max(axis=0),
        "acceleration_rad_s2": limits.acceleration - np.abs(samples.qdd).max(axis=0),
        "jerk_rad_s3": limits.jerk - np.abs(trajectory.jerk).max(axis=0),
        "effort_nm": limits.effort - np.abs(trajectory.effort).max(axis=(0, 1)),
    }


def appraise(
    motions: Sequence[FourierSeries],
    workspace: Workspace,
    setting: Setting,
    limits: Limits,
    *,
    rotor: bool = True,
    friction: bool = False,
) -> Appraisal:
    """Return the information of trajectories and their margins to the limits.

    Args:
        motions: Trajectories to appraise, at least one.
        workspace: Workspace of the arm.
        setting: Robot model and its payloads.
        limits: Limits of the trajectories.
        rotor: Flag; if true, rotor inertias are among the parameters.
        friction: Flag; if true, Coulomb friction, viscous friction and torque offsets are among the
            parameters.
    """
    regressor = Regressor(setting.robot, rotor=rotor, friction=friction)
    out: list[Trajectory] = []
    for series in motions:
        samples = series.sample(workspace.rate_hz)
        alone = regressor.information(*_thinned(samples))
        jointly = out[-1].jointly.with_more(alone) if out else alone
        effort = _effort(setting, samples)
        jerk = jerk_of(series, samples.t)
        clearance = workspace.clearance(samples.q)
        closest = _closest(workspace, samples, clearance)
        out.append(Trajectory(series, samples, jerk, effort, clearance, alone, jointly, closest))
    return Appraisal(workspace.joint_names, limits, tuple(out))


def _thinned(samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray]:
    every = max(1, len(samples) // REGRESSOR_ROWS)
    return samples.q[::every], samples.qd[::every], samples.qdd[::every]


def _effort(setting: Setting, samples: Samples) -> FloatArray:
    loads = [setting.robot.with_payload(load) for load in dict.fromkeys(setting.loads)]
    return np.stack([load.inverse_dynamics(samples.q, samples.qd, samples.qdd) for load in loads])


def _closest(workspace: Workspace, samples: Samples, clearance: FloatArray) -> Closest:
    nearest = int(clearance.argmin())
    distance, bodies = workspace.collision.closest(samples.q[nearest])
    return Closest(distance, bodies, float(samples.t[nearest]))


def jerk_of(series: FourierSeries, t: FloatArray) -> FloatArray:
    """Return the jerk (N, n) of a series at times `t` (N,) [rad/s³]."""
    omega = 2 * np.pi * series.fundamental_hz * np.arange(1.0, len(series.a[0]) + 1)
    phase = t[:, None] * omega
    a, b = (omega[:, None] ** 2 * np.array(rows).T for rows in (series.a, series.b))
    return np.asarray(-np.cos(phase) @ a - np.sin(phase) @ b)


SIGN_WIDTH_RAD_S = 0.01
"""Width of tanh(qd / width), the smooth sign function in Coulomb columns [rad/s]."""


class Regressor:
    """Base regressor of a robot, with optional friction columns.

    Args:
        robot: Robot model.
        rotor: Flag; if true, rotor inertias are among the parameters.
        friction: Flag; if true, Coulomb friction, viscous friction and torque offset of each joint
            are among the parameters.
    """

    def __init__(self, robot: RobotModel, *, rotor: bool = True, friction: bool = False) -> None:
        self._robot = robot
        self._rotor, self._friction = rotor, friction
        self._base = base_parameters(robot, rotor=rotor)
        joints = range(1, robot.n + 1)
        more = [f"{name}_{joint}" for name in ("Fc", "Fv", "offset") for joint in joints]
        self.names = (*self._base.names, *(more if friction else ()))

    def columns(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the regressor (N·n, b) at the samples q, qd, qdd, each (N, n)."""
        W = self._base.reduce(self._robot.regressor(q, qd, qdd, rotor=self._rotor))
        if not self._friction:
            return W
        signals = (np.tanh(qd / SIGN_WIDTH_RAD_S), qd, np.ones_like(qd))
        return np.hstack([W, *(_of_each_joint(signal) for signal in signals)])

    def information(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Information:
        """Return the information of the samples q, qd, qdd, each (N, n)."""
        return Information(_triangle(self.columns(q, qd, qdd)), self.names)


def _of_each_joint(signal: FloatArray) -> FloatArray:
    """Return regressor columns (N·n, n) with one parameter per joint, for a signal (N, n)."""
    samples, n = signal.shape
    out = np.zeros((samples, n, n))
    out[:, np.arange(n), np.arange(n)] = signal
    return out.reshape(-1, n)
