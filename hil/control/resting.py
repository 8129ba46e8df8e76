"""An arm at rest as an optimisation sees it: what its brakes hold, and where it may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hil.core import BoolArray, FloatArray, PlanError

STIFFNESS_STEP_RAD = 1e-4
"""Of the central differences of the torque."""

DISTANCE_STEP_RAD = 1e-6
"""Of the forward differences of distances, which have kinks."""

TOLERANCE_RAD = 1e-9
TOLERANCE_M = 1e-7


class Distances(Protocol):
    """What is needed of a collision model (`hil.dynamics.CollisionModel`)."""

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n); negative where bodies overlap."""

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and between which two bodies."""


@dataclass(frozen=True, eq=False)
class RestingArm:
    """An arm that is to stand still with its brakes on.

    Attributes:
        joint_names: Length n.
        gravity: (N, n) torques [N·m] that hold the arm and its load at positions (N, n).
        limit: (n,) torque limits [N·m], the measure of every torque.
        low, high: (n,) range of the joints [rad], margin taken off; infinite for endless joints.
        friction: (n,) dry friction [N·m], None where nobody knows.
        around: Distances to itself and its surroundings; None leaves them unchecked.
        clearance_m: Distance that is kept.

    Raises:
        PlanError: The range of a joint is empty, or a torque limit is missing.
    """

    joint_names: tuple[str, ...]
    gravity: Callable[[FloatArray], FloatArray]
    limit: FloatArray
    low: FloatArray
    high: FloatArray
    friction: FloatArray | None = None
    around: Distances | None = None
    clearance_m: float = 0.0

    def __post_init__(self) -> None:
        self._refuse(
            self.low >= self.high, "no position is within the limits of", "lower the margin"
        )
        self._refuse(
            ~(np.isfinite(self.limit) & (self.limit > 0)),
            "the robot model has no torque limits for",
            "write them into the URDF (<limit effort=…>)",
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def share(self, q: FloatArray) -> FloatArray:
        """(N, n) torque as a share of the limit, with its sign, at `q` (N, n)."""
        share: FloatArray = self.gravity(q) / self.limit
        return share

    def effort(self, q: FloatArray) -> FloatArray:
        """(N,) root mean square of the shares: what the search makes small."""
        return np.asarray(np.sqrt(np.mean(self.share(q) ** 2, axis=1)))

    def stiffness(self, q: FloatArray) -> FloatArray:
        """(n, n) change of the gravity torques per joint angle [N·m/rad] at `q` (n,).

        The Hessian of the potential energy, wherever the torques have one.
        """
        return self.torque_and_stiffness(q)[1]

    def torque_and_stiffness(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) torques [N·m] and (n, n) `stiffness` at `q` (n,), from one call of the model."""
        step = STIFFNESS_STEP_RAD * np.eye(self.n)
        torque = self.gravity(np.concatenate([q[None], q + step, q - step]))
        change = (torque[1 : self.n + 1] - torque[self.n + 1 :]) / (2 * STIFFNESS_STEP_RAD)
        return torque[0], change.T

    def room(self, q: FloatArray) -> FloatArray:
        """(R,) distances beyond the clearance [m] at `q` (n,); empty where nothing is checked."""
        return self._rooms(q[None])[:, 0]

    def room_slopes(self, q: FloatArray) -> FloatArray:
        """(R, n) derivative of `room` at `q` (n,)."""
        moved = np.concatenate([q[None], q + DISTANCE_STEP_RAD * np.eye(self.n)])
        rooms = self._rooms(moved)
        slopes: FloatArray = (rooms[:, 1:] - rooms[:, :1]) / DISTANCE_STEP_RAD
        return slopes

    def is_clear(self, q: FloatArray) -> BoolArray:
        """(N,) whether each of `q` (N, n) is within limits and keeps its distance."""
        low, high = self.low - TOLERANCE_RAD, self.high + TOLERANCE_RAD
        inside = np.all((q >= low) & (q <= high), axis=1)
        least = self._rooms(q).min(axis=0, initial=np.inf)
        return np.asarray(inside & (least >= -TOLERANCE_M))

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Smallest distance [m] at `q` (n,), and between what; infinite where unchecked."""
        return (np.inf, ("", "")) if self.around is None else self.around.closest(q)

    def _rooms(self, q: FloatArray) -> FloatArray:
        if self.around is None:
            return np.empty((0, len(q)))
        rooms: FloatArray = self.around.distances(q) - self.clearance_m
        return rooms

    def _refuse(self, wrong: BoolArray, what: str, hint: str) -> None:
        if np.any(wrong):
            named = [n for n, bad in zip(self.joint_names, wrong, strict=True) if bad]
            raise PlanError(f"{what} {', '.join(named)}", hint=hint)
