"""What an optimised Fourier excitation is asked for: arm, limits, series and objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from hil.core import BoolArray, FloatArray, PlanError
from hil.dynamics import IdentificationColumns
from hil.excitation.optimiser.series_basis import SeriesBasis

if TYPE_CHECKING:
    from hil.dynamics import BaseParameters, IdentificationColumns, RobotModel
    from hil.excitation.motion import FourierSeries

Objective = Literal["condition", "log_det"]

SAMPLES_PER_HARMONIC = 20
"""Of the grid the objective is computed on: five harmonics give the 100 samples that rank series
as well as 1000 do."""

LEAST_HARMONICS = 2
"""One alone cannot rest at both ends."""


class Distances(Protocol):
    """Distances that follow from the joint positions.

    `hil.dynamics.collision.CollisionModel` and `hil.dynamics.flange.FlangeSpace` are such.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """(R,) between which two things."""

    @property
    def reach(self) -> FloatArray:
        """(R, n) metres that each can change per radian of each joint, at most."""

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distance of every pair of bodies at every sample [m], for `q` (N, n)."""


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
