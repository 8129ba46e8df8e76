"""Limits that are not linear in the coefficients: torques, and the distance to everything."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from hil.core import FloatArray, IntArray
from hil.excitation.optimiser.linear_limits import POINTS_PER_HARMONIC

if TYPE_CHECKING:
    from hil.dynamics import RobotModel
    from hil.excitation.optimiser.problem import Distances, ExcitationProblem

DISTANCE_SCALE_M = 0.1
"""An excess of 1 is so much too close, or all of a torque limit too much."""

DIFFERENCE_RAD = 1e-6

TORQUES_AT_ONCE = 500

RESERVE = 0.005
"""Taken off every limit from the first: for what is exceeded between the points, and because steps
come near to limits like these but seldom upon them."""

TOLERATED = 0.5 * RESERVE
"""Excess over a limit less its reserve that counts as none."""


class Motion(NamedTuple):
    """Samples of a motion, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


def torques(robot: RobotModel, at: Motion) -> FloatArray:
    """(N, n) of the nominal model, in blocks: to compile for many samples would take longer."""
    blocks = zip(*(np.array_split(x, 1 + len(x) // TORQUES_AT_ONCE) for x in at), strict=True)
    return np.concatenate([robot.inverse_dynamics(*block) for block in blocks])


class MotionLimit(Protocol):
    """A limit on every sample of a motion by itself."""

    def excess(self, at: Motion) -> FloatArray:
        """(R, N) by how much each of its rows is exceeded at each sample; negative where not."""

    def gradient(self, at: Motion, row: IntArray) -> Motion:
        """Derivatives of the excess of row `row[k]` by sample k, each (N, n)."""

    def complaint(self, at: Motion) -> str:
        """What is worst about a motion."""


class EffortLimit:
    """Torques of the nominal model within limits: rows are upper limits, then lower ones."""

    def __init__(self, problem: ExcitationProblem) -> None:
        self._robot, self._most = problem.robot, problem.limit("effort_max")

    def excess(self, at: Motion) -> FloatArray:
        """(2n, N) share of the limit."""
        share = (torques(self._robot, at) / self._most).T
        return np.concatenate([share, -share]) - 1.0

    def gradient(self, at: Motion, row: IntArray) -> Motion:
        """From the derivatives of inverse dynamics."""
        sign, joint = np.divmod(row, self._robot.n)
        factor = ((1.0 - 2.0 * sign) / self._most[joint])[:, None]
        samples = np.arange(len(row))
        parts = self._robot.inverse_dynamics_derivatives(*at)
        return Motion(*(factor * part[samples, joint] for part in parts))

    def complaint(self, at: Motion) -> str:
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

    def excess(self, at: Motion) -> FloatArray:
        """(R, N) of `DISTANCE_SCALE_M`."""
        return (self._kept - self._model.distances(at.q)) / DISTANCE_SCALE_M

    def gradient(self, at: Motion, row: IntArray) -> Motion:
        """By central differences, all different samples and joints in one call."""
        q, number = np.unique(at.q, axis=0, return_inverse=True)
        N, n = q.shape
        steps = DIFFERENCE_RAD * np.stack([np.eye(n), -np.eye(n)])
        moved = (q + steps[:, :, None]).reshape(-1, n)
        distances = self._model.distances(moved).reshape(len(self._model.names), 2, n, N)
        distances = distances[row, :, :, number]
        slope = (distances[:, 1] - distances[:, 0]) / (2.0 * DIFFERENCE_RAD * DISTANCE_SCALE_M)
        return Motion(slope, np.zeros_like(slope), np.zeros_like(slope))

    def closest(self, at: Motion) -> tuple[float, tuple[str, str]]:
        """Least distance beyond the one that is kept [m], and between what."""
        distances = self._model.distances(at.q)
        row = int(np.unravel_index(distances.argmin(), distances.shape)[0])
        return float(distances.min()) - self._kept, self._model.names[row]

    def complaint(self, at: Motion) -> str:
        """The bodies that are closest."""
        beyond, bodies = self.closest(at)
        return (
            f"{' and '.join(bodies)} come as near as {1e3 * (beyond + self._kept):.0f} mm where "
            f"{1e3 * self._kept:.0f} mm are kept"
        )


class SpaceLimit(DistanceLimit):
    """The flange inside its space."""

    def complaint(self, at: Motion) -> str:
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

    def motion(self, free: FloatArray, denser: int = 1) -> Motion:
        """Samples of the motion with free coefficients (n, f)."""
        maps = self._maps
        if denser > 1:
            maps = np.stack(self._basis.grid(denser * self._points)[:3])
        return Motion(*np.matmul(maps, free.T))

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
            last = first + len(limit.excess(Motion(*(x[:1] for x in at))))
            mine = np.flatnonzero((row >= first) & (row < last))
            some = Motion(*(x[sample[mine]] for x in at))
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
