"""Time-optimal rest-to-rest profiles of one scalar, computed by ruckig and sampled by numpy.

A straight line in joint space needs one scalar profile only: the distance covered by the joint
that has furthest to go. Ruckig is asked for exactly that, one degree of freedom from rest to rest
and never with intermediate positions (those would be sent to a server on the internet).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.core import FloatArray, PlanError

LONGEST_S = 7600.0
"""Ruckig warrants its precision up to here."""


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Seven phases of constant jerk.

    Attributes:
        t: (7,) times at which the phases begin [s].
        duration_s: Time at which the last phase ends.
        coefficients: (7, 4) position, velocity, half acceleration and a sixth of the jerk at the
            beginning of each phase.
    """

    t: FloatArray
    duration_s: float
    coefficients: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, velocity and acceleration, each (N,), at `t` (N,) within [0, duration]."""
        phase = np.searchsorted(self.t, t, side="right") - 1
        dt = t - self.t[phase]
        p, v, a, j = self.coefficients[phase].T
        return (
            p + dt * (v + dt * (a + dt * j)),
            v + dt * (2 * a + dt * 3 * j),
            2 * a + 6 * dt * j,
        )


@lru_cache(maxsize=8192)
def rest_to_rest(distance: float, velocity: float, acceleration: float, jerk: float) -> Profile:
    """The fastest profile from 0 to `distance` > 0 within the three limits (any one unit).

    Raises:
        PlanError: Ruckig finds no profile, for example because a limit is extreme.
    """
    import ruckig

    wanted = ruckig.InputParameter(1)
    wanted.current_position, wanted.target_position = [0.0], [distance]
    wanted.max_velocity, wanted.max_acceleration = [velocity], [acceleration]
    wanted.max_jerk = [jerk]
    wanted.synchronization = ruckig.Synchronization.Phase
    wanted.duration_discretization = ruckig.DurationDiscretization.Continuous
    found = ruckig.Trajectory(1)
    try:
        result = str(ruckig.Ruckig(1).calculate(wanted, found))
    except ruckig.RuckigError as error:
        result = str(error).strip().partition(",")[0]
    if result not in (str(ruckig.Result.Working), str(ruckig.Result.Finished)):
        raise PlanError(
            f"no motion over {distance:.3g} rad within {velocity:.3g} rad/s, "
            f"{acceleration:.3g} rad/s², {jerk:.3g} rad/s³: {result}",
            hint="use limits within a few orders of magnitude of each other",
        )
    if found.duration > LONGEST_S:
        raise PlanError(
            f"a motion over {distance:.3g} rad would take {found.duration:.0f} s",
            hint="raise excitation.max_velocity_deg_s or excitation.max_acceleration_deg_s2",
        )
    return _from_ruckig(found)


def _from_ruckig(found: object) -> Profile:
    phases = found.profiles[0][0]  # type: ignore[attr-defined]
    columns = (phases.p[:7], phases.v[:7], phases.a[:7], phases.j)
    scale = np.array([1.0, 1.0, 0.5, 1 / 6])
    ends = np.cumsum(phases.t)
    return Profile(np.concatenate(([0.0], ends[:-1])), float(ends[-1]), np.array(columns).T * scale)
