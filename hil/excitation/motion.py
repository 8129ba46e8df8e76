"""Motions of the joints: lines, Fourier series and stays at a pose, sampled by numpy.

A straight line in joint space needs one scalar profile only, the distance covered by the joint
that has furthest to go. ruckig computes it as one degree of freedom from rest to rest, and never
with intermediate positions: those would be sent to a server on the internet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np

from hil.core import FloatArray, PlanError

STANDSTILL_RAD = 1e-9
"""Shorter ways than this are none: ruckig fails on them, and no encoder sees them."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Set-points at a fixed rate: `t` (N,), `q`, `qd`, `qdd` (N, n) in rad, rad/s, rad/s²."""

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray

    def __len__(self) -> int:
        return len(self.t)


class Motion(Protocol):
    """A commanded motion from rest to rest."""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last set-point [s]."""

    @property
    def q_start(self) -> FloatArray:
        """Joint position before the first set-point, (n,)."""

    @property
    def q_end(self) -> FloatArray:
        """Joint position of the last set-point, (n,)."""

    def sample(self, rate_hz: float) -> Samples:
        """Set-points at t = 1/rate, 2/rate, … up to and including `duration_s`."""

    def to_dict(self) -> dict[str, Any]:
        """JSON form with a `kind` key; floats survive the round trip exactly."""


@dataclass(frozen=True)
class Line:
    """Rest to rest on a straight line in joint space, as fast as the limits allow.

    The joint with furthest to go binds; the others follow in proportion, so the line is exact.
    The fastest profile of duration T is stretched uniformly to T', the next multiple of
    1/`rate_hz`, as q(t·T/T'): set-points end exactly at the goal, and velocity, acceleration and
    jerk only become smaller. (Ruckig's own discrete durations and `minimum_duration` silently
    leave the line.)

    Attributes:
        start, goal: Joint positions [rad], length n.
        velocity, acceleration, jerk: Limits for every joint [rad/s, rad/s², rad/s³].
        rate_hz: Command rate whose period the duration is a multiple of.
    """

    start: tuple[float, ...]
    goal: tuple[float, ...]
    velocity: float
    acceleration: float
    jerk: float
    rate_hz: float

    @cached_property
    def distance(self) -> float:
        """Way of the joint that has furthest to go [rad]."""
        return max(abs(b - a) for a, b in zip(self.start, self.goal, strict=True))

    @property
    def duration_s(self) -> float:
        """A multiple of the command period, at least one [s]."""
        return self._periods / self.rate_hz

    @property
    def q_start(self) -> FloatArray:
        """(n,)."""
        return np.array(self.start)

    @property
    def q_end(self) -> FloatArray:
        """(n,)."""
        return np.array(self.goal)

    def sample(self, rate_hz: float) -> Samples:
        """Set-points, the last one exactly at the goal and at rest."""
        t = _grid(self.duration_s, rate_hz)
        way = self.q_end - self.q_start
        if self.distance < STANDSTILL_RAD:
            still = np.zeros((len(t), len(way)))
            return Samples(t, still + self.q_end, still, still)
        profile = self._profile
        stretch = profile.duration_s / self.duration_s
        s, sd, sdd = profile.at(t * stretch)
        way = way / self.distance
        q = self.q_start + s[:, None] * way
        qd = (sd * stretch)[:, None] * way
        qdd = (sdd * stretch**2)[:, None] * way
        q[-1], qd[-1], qdd[-1] = self.goal, 0.0, 0.0
        return Samples(t, q, qd, qdd)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "kind": "line",
            "start_rad": list(self.start),
            "goal_rad": list(self.goal),
            "velocity_rad_s": self.velocity,
            "acceleration_rad_s2": self.acceleration,
            "jerk_rad_s3": self.jerk,
            "rate_hz": self.rate_hz,
        }

    @property
    def _profile(self) -> Profile:
        return rest_to_rest(self.distance, self.velocity, self.acceleration, self.jerk)

    @cached_property
    def _periods(self) -> int:
        if self.distance < STANDSTILL_RAD:
            return 1
        return max(1, int(np.ceil(self._profile.duration_s * self.rate_hz - 1e-9)))


def _grid(duration_s: float, rate_hz: float) -> FloatArray:
    """1/rate, 2/rate, …; the last point is `duration_s` itself, whatever the rounding."""
    n = max(1, int(np.ceil(duration_s * rate_hz - 1e-6)))
    t = np.arange(1, n + 1) / rate_hz
    t[-1] = duration_s
    return t


@dataclass(frozen=True, slots=True)
class FourierSeries:
    """Finite Fourier series per joint, eq. 29 of the PINN paper.

    q(t) = q₀ + Σᵢ aᵢ/(i·ω)·sin(i·ω·t) − bᵢ/(i·ω)·cos(i·ω·t), i = 1…H. Note that q(0) is not q₀.
    The motion is at rest at both ends when Σ aᵢ = 0 and Σ i·bᵢ = 0 for every joint.

    Attributes:
        q0: Centre of the motion [rad], length n.
        a, b: n rows of H coefficients [rad/s].
        fundamental_hz: ω/2π.
        periods: Number of repetitions.
    """

    q0: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[tuple[float, ...], ...]
    fundamental_hz: float
    periods: int = 1

    @property
    def duration_s(self) -> float:
        """All periods together [s]."""
        return self.periods / self.fundamental_hz

    @property
    def q_start(self) -> FloatArray:
        """(n,): q(0), where the cosines do not vanish."""
        omega_i = 2 * np.pi * self.fundamental_hz * np.arange(1, len(self.b[0]) + 1)
        cosines: FloatArray = (np.array(self.b) / omega_i).sum(axis=1)
        return np.array(self.q0) - cosines

    @property
    def q_end(self) -> FloatArray:
        """(n,): the same as `q_start`, the series being periodic."""
        return self.q_start

    def sample(self, rate_hz: float) -> Samples:
        """Set-points; velocities and accelerations are the analytic derivatives."""
        t = _grid(self.duration_s, rate_hz)
        omega_i, sin, cos = _harmonics(self.fundamental_hz, len(self.a[0]), self.periods, rate_hz)
        a, b = np.array(self.a).T, np.array(self.b).T
        q = np.array(self.q0) + sin @ (a / omega_i) - cos @ (b / omega_i)
        return Samples(t, q, cos @ a + sin @ b, cos @ (b * omega_i) - sin @ (a * omega_i))

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "kind": "fourier",
            "q0_rad": list(self.q0),
            "a_rad_s": [list(row) for row in self.a],
            "b_rad_s": [list(row) for row in self.b],
            "fundamental_hz": self.fundamental_hz,
            "periods": self.periods,
        }


@lru_cache(maxsize=8)
def _harmonics(
    fundamental_hz: float, harmonics: int, periods: int, rate_hz: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """i·ω as a column (H, 1), and sin and cos of i·ω·t (N, H): shared by all joints."""
    omega_i = 2 * np.pi * fundamental_hz * np.arange(1.0, harmonics + 1)[:, None]
    phase: FloatArray = _grid(periods / fundamental_hz, rate_hz)[:, None] * omega_i.T
    return omega_i, np.sin(phase), np.cos(phase)


@dataclass(frozen=True, slots=True)
class Hold:
    """Standing still at `q` [rad]; how long is the dwell rule's business."""

    q: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """0: the one set-point is reached as soon as it is given."""
        return 0.0

    @property
    def q_start(self) -> FloatArray:
        """(n,)."""
        return np.array(self.q)

    @property
    def q_end(self) -> FloatArray:
        """(n,)."""
        return np.array(self.q)

    def sample(self, rate_hz: float) -> Samples:
        """One set-point."""
        q = np.array([self.q])
        return Samples(np.zeros(1), q, np.zeros_like(q), np.zeros_like(q))

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"kind": "hold", "q_rad": list(self.q)}


def motion_from_dict(raw: dict[str, Any]) -> Motion:
    """Inverse of `Motion.to_dict`.

    Raises:
        PlanError: `kind` names no motion of this version.
    """
    match raw:
        case {"kind": "line"}:
            limits = (raw["velocity_rad_s"], raw["acceleration_rad_s2"], raw["jerk_rad_s3"])
            return Line(tuple(raw["start_rad"]), tuple(raw["goal_rad"]), *limits, raw["rate_hz"])
        case {"kind": "fourier"}:
            a, b = (tuple(tuple(row) for row in raw[key]) for key in ("a_rad_s", "b_rad_s"))
            return FourierSeries(tuple(raw["q0_rad"]), a, b, raw["fundamental_hz"], raw["periods"])
        case {"kind": "hold"}:
            return Hold(tuple(raw["q_rad"]))
    raise PlanError(
        f"the plan holds a motion of kind {raw.get('kind')!r}, which this version does not know",
        hint="make the plan again with this version of hil",
    )


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
