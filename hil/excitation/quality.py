"""What samples tell about a robot's parameters, and what trajectories leave of every limit.

`Information` is the triangle of a regressor: condition numbers and standard errors follow from it.
`appraise` computes everything from the finished motions at the robot's own samples; nothing is
taken from the search that found them.
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
"""Samples of a trajectory that its regressor is computed from, at most about."""


class Limits(NamedTuple):
    """What trajectories have to keep to: each (n,), infinite where there is no limit.

    `q_min` and `q_max` [rad], `velocity` [rad/s], `acceleration` [rad/s²], `jerk` [rad/s³],
    `effort` [N·m], `clearance_m`.
    """

    q_min: FloatArray
    q_max: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    effort: FloatArray
    clearance_m: float


class Closest(NamedTuple):
    """The smallest distance to anything [m], between which bodies, and when [s]."""

    distance_m: float
    bodies: tuple[str, str]
    at_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """The triangle R of a regressor W = Q·R, which tells as much about parameters as W itself.

    Attributes:
        triangle: (b, b) upper triangle.
        names: (b,) of the parameters.
    """

    triangle: FloatArray
    names: tuple[str, ...]

    def with_more(self, other: Information) -> Information:
        """What both tell together."""
        stacked = np.vstack([self.triangle, other.triangle])
        return Information(_triangle(stacked), self.names)

    @property
    def condition_raw(self) -> float:
        """Condition number of the regressor as it stands, in mixed units."""
        return float(np.linalg.cond(self.triangle))

    @property
    def condition_scaled(self) -> float:
        """Condition number with every column scaled to length 1."""
        values = self.singular_values
        return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")

    @property
    def singular_values(self) -> FloatArray:
        """(b,) of the regressor with every column scaled to length 1, largest first."""
        length = np.linalg.norm(self.triangle, axis=0)
        scaled = self.triangle / np.where(length > 0, length, 1.0)
        return np.asarray(np.linalg.svd(scaled, compute_uv=False))

    @property
    def standard_errors(self) -> FloatArray:
        """(b,) of parameters fitted by least squares, per unit of noise in every effort.

        All infinite where the samples do not determine every parameter.
        """
        if np.any(np.diag(self.triangle) == 0):
            return np.full(len(self.names), np.inf)
        inverse = scipy.linalg.solve_triangular(self.triangle, np.eye(len(self.names)))
        return np.asarray(np.linalg.norm(inverse, axis=1))


def _triangle(W: FloatArray) -> FloatArray:
    """(b, b) of a regressor (M, b), with rows of zeros where it is shorter than wide."""
    rows: FloatArray = scipy.linalg.qr(W, mode="r")[0][: W.shape[1]]
    return np.pad(rows, ((0, W.shape[1] - len(rows)), (0, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """One trajectory.

    Attributes:
        series: The motion.
        samples: Its set-points.
        jerk: (N, n) [rad/s³].
        effort: (L, N, n) torque of the nominal rigid body with each load [N·m].
        clearance: (N,) distance to anything [m].
        alone: What it tells by itself.
        jointly: What it tells together with those before it.
        closest: Where it comes closest to something.
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
    """All trajectories of a program.

    Attributes:
        joint_names: (n,).
        limits: What they keep to.
        trajectories: In order.
    """

    joint_names: tuple[str, ...]
    limits: Limits
    trajectories: tuple[Trajectory, ...]

    @property
    def jointly(self) -> Information:
        """What all of them tell together."""
        return self.trajectories[-1].jointly

    @property
    def closest(self) -> tuple[int, Closest]:
        """Number of the trajectory that comes closest to something, and where it does."""
        closest = [trajectory.closest for trajectory in self.trajectories]
        number = min(range(len(closest)), key=lambda i: closest[i].distance_m)
        return number, closest[number]

    @property
    def margins(self) -> dict[str, FloatArray]:
        """(n,) what all of them together leave of each limit, by name and unit."""
        each = [margins_of(trajectory, self.limits) for trajectory in self.trajectories]
        return {name: np.min([margins[name] for margins in each], axis=0) for name in each[0]}


def margins_of(trajectory: Trajectory, limits: Limits) -> dict[str, FloatArray]:
    """(n,) what one trajectory leaves of each limit, by name and unit; negative beyond it."""
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
    """Appraise trajectories.

    Args:
        motions: At least one.
        workspace: Where they are.
        setting: The robot and its loads.
        limits: What they have to keep to.
        rotor: Whether rotor inertias count as parameters.
        friction: Whether Coulomb, viscous and offset friction do.
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
    """(N, n) third derivative of a series at times `t` (N,) [rad/s³]."""
    omega = 2 * np.pi * series.fundamental_hz * np.arange(1.0, len(series.a[0]) + 1)
    phase = t[:, None] * omega
    a, b = (omega[:, None] ** 2 * np.array(rows).T for rows in (series.a, series.b))
    return np.asarray(-np.cos(phase) @ a - np.sin(phase) @ b)


SIGN_WIDTH_RAD_S = 0.01
"""Of tanh(qd / width), which stands for the sign in Coulomb columns."""


class Regressor:
    """The base regressor of a robot, with columns of friction on request.

    Args:
        robot: The arm.
        rotor: Whether rotor inertias count as parameters.
        friction: Whether Coulomb, viscous and offset friction of each joint do.
    """

    def __init__(self, robot: RobotModel, *, rotor: bool = True, friction: bool = False) -> None:
        self._robot = robot
        self._rotor, self._friction = rotor, friction
        self._base = base_parameters(robot, rotor=rotor)
        joints = range(1, robot.n + 1)
        more = [f"{name}_{joint}" for name in ("Fc", "Fv", "offset") for joint in joints]
        self.names = (*self._base.names, *(more if friction else ()))

    def columns(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N·n, b) regressor at q, qd, qdd, each (N, n)."""
        W = self._base.reduce(self._robot.regressor(q, qd, qdd, rotor=self._rotor))
        if not self._friction:
            return W
        signals = (np.tanh(qd / SIGN_WIDTH_RAD_S), qd, np.ones_like(qd))
        return np.hstack([W, *(_of_each_joint(signal) for signal in signals)])

    def information(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Information:
        """What samples tell; q, qd, qdd each (N, n)."""
        return Information(_triangle(self.columns(q, qd, qdd)), self.names)


def _of_each_joint(signal: FloatArray) -> FloatArray:
    """(N·n, n) columns of one parameter per joint, for a signal (N, n)."""
    samples, n = signal.shape
    out = np.zeros((samples, n, n))
    out[:, np.arange(n), np.arange(n)] = signal
    return out.reshape(-1, n)
