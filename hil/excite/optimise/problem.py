"""What an optimised Fourier excitation is asked for: arm, limits, series and objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol


from hil.typing import FloatArray

if TYPE_CHECKING:
    from hil.dynamics.robot_model import RobotModel
    from hil.excite.motion import FourierSeries

Objective = Literal["condition", "log_det"]

SAMPLES_PER_HARMONIC = 20
"""Of the grid the objective is computed on: five harmonics give the 100 samples that rank series
as well as 1000 do."""


class Distances(Protocol):
    """What is needed of a collision model (`hil.dynamics.collision.CollisionModel`)."""

    names: list[tuple[str, str]]
    reach: FloatArray

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distance of every pair of bodies at every sample [m], for `q` (N, n)."""


@dataclass(frozen=True, eq=False)
class ExcitationProblem:
    """One Fourier series to be found.

    Limits are one number for all joints or one per joint; infinite ones do not count.

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
            to `log_det`'s optimum.
        rotor: Whether rotor inertias are among the parameters.
        friction: Whether Coulomb, viscous and offset columns are.
        sign_width: Of tanh(qd / width), which stands for the sign in Coulomb columns [rad/s].
        earlier: (k, b) rows that carry the information of earlier trajectories: their regressor or
            a triangle of it, columns as in `columns`. None for none. See `after`.
        collision: Distances of the arm with its load, None for no check.
        clearance_m: Distance that is kept to everything.
        samples: Of the objective's grid; 0 for `SAMPLES_PER_HARMONIC` per harmonic.
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
    clearance_m: float = 0.0
    samples: int = 0

    def after(self, *series: FourierSeries) -> ExcitationProblem:
        """The same problem for a trajectory that is to complement `series`.

        Condition number and determinant are then those of all of them together.
        """
        raise NotImplementedError
