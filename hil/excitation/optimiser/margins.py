"""What a series leaves of every limit, on a grid ten times denser than the limits' own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser.linear_limits import POINTS_PER_HARMONIC
from hil.excitation.optimiser.motion_limits import DistanceLimit, Motion, torques
from hil.excitation.optimiser.result import Margins

if TYPE_CHECKING:
    from hil.excitation.optimiser.problem import ExcitationProblem

DENSER = 10


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
    motion = Motion(q, qd, qdd)
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
