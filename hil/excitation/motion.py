"""Joint motions: straight lines, Fourier series and dwells at a pose, sampled with numpy.

A straight line in joint space needs only one scalar profile: the distance of the joint with the
longest path. Ruckig computes the scalar profile of a line as one degree of freedom from rest to
rest. Intermediate positions are never passed to Ruckig, because Ruckig would send them to a server
on the internet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np

from hil.core import FloatArray, PlanError

STANDSTILL_RAD = 1e-9
"""Distance below which a motion is treated as no motion: Ruckig fails on such a distance, and no
encoder resolves it.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Set-points at a fixed rate: `t` (N,) [s]; `q`, `qd`, `qdd` (N, n) [rad, rad/s, rad/s²]."""

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray

    def __len__(self) -> int:
        return len(self.t)


class Motion(Protocol):
    """Commanded motion from rest to rest."""

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
        """Return set-points at t = 1/rate, 2/rate, … up to and including `duration_s`."""

    def to_dict(self) -> dict[str, Any]:
        """Return the motion as a JSON object with a `kind` key; floats keep their exact values."""


@dataclass(frozen=True)
class Line:
    """Straight line in joint space from rest to rest, as short in time as the limits allow.

    The joint with the longest path determines the duration. The other joints move in proportion to
    the joint with the longest path, so the line is exactly straight. The fastest profile has
    duration T. The profile is stretched uniformly to T', the next multiple of 1/`rate_hz`, as
    q(t·T/T'). The set-points of the stretched profile end exactly at the goal, and velocity,
    acceleration and jerk only become smaller. (Ruckig's own discrete durations and
    `minimum_duration` would leave the line without an error.)

    Attributes:
        start, goal: Joint positions at the start and at the end of the line [rad], length n.
        velocity, acceleration, jerk: Limits for every joint [rad/s, rad/s², rad/s³].
        rate_hz: Command rate [Hz]; the duration of the line is a multiple of the command period.
    """

    start: tuple[float, ...]
    goal: tuple[float, ...]
    velocity: float
    acceleration: float
    jerk: float
    rate_hz: float

    @cached_property
    def distance(self) -> float:
        """Distance of the joint with the longest path [rad]."""
        return max(abs(b - a) for a, b in zip(self.start, self.goal, strict=True))

    @property
    def duration_s(self) -> float:
        """Duration of the line [s], a multiple of the command period and at least one period."""
        return self._periods / self.rate_hz

    @property
    def q_start(self) -> FloatArray:
        """Start position (n,) [rad]."""
        return np.array(self.start)

    @property
    def q_end(self) -> FloatArray:
        """Goal position (n,) [rad]."""
        return np.array(self.goal)

    def sample(self, rate_hz: float) -> Samples:
        """Return the set-points of the line; the last one is exactly at the goal and at rest."""
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
        """Return the line as a JSON object."""
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
    """Return times 1/rate, 2/rate, …; the last time is exactly `duration_s`."""
    n = max(1, int(np.ceil(duration_s * rate_hz - 1e-6)))
    t = np.arange(1, n + 1) / rate_hz
    t[-1] = duration_s
    return t


@dataclass(frozen=True, slots=True)
class FourierSeries:
    """Motion with one finite Fourier series per joint (eq. 29, PINN paper).

    q(t) = q₀ + Σᵢ aᵢ/(i·ω)·sin(i·ω·t) − bᵢ/(i·ω)·cos(i·ω·t), i = 1…H. The start position q(0) of a
    Fourier series differs from its centre q₀. The Fourier motion is at rest at both ends if Σ aᵢ =
    0 and Σ i·bᵢ = 0 for every joint.

    Attributes:
        q0: Centre of the motion [rad], length n.
        a, b: Arrays (n, H) of coefficients [rad/s], one row per joint.
        fundamental_hz: Fundamental frequency ω/2π [Hz].
        periods: Number of periods of the motion.
    """

    q0: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b: tuple[tuple[float, ...], ...]
    fundamental_hz: float
    periods: int = 1

    @property
    def duration_s(self) -> float:
        """Duration of all periods together [s]."""
        return self.periods / self.fundamental_hz

    @property
    def q_start(self) -> FloatArray:
        """Start position q(0) (n,) [rad], which differs from q₀ by the cosine terms."""
        omega_i = 2 * np.pi * self.fundamental_hz * np.arange(1, len(self.b[0]) + 1)
        cosines: FloatArray = (np.array(self.b) / omega_i).sum(axis=1)
        return np.array(self.q0) - cosines

    @property
    def q_end(self) -> FloatArray:
        """End position (n,) [rad], equal to `q_start` because the series is periodic."""
        return self.q_start

    def sample(self, rate_hz: float) -> Samples:
        """Return the set-points of the series, with analytic velocities and accelerations."""
        t = _grid(self.duration_s, rate_hz)
        omega_i, sin, cos = _harmonics(self.fundamental_hz, len(self.a[0]), self.periods, rate_hz)
        a, b = np.array(self.a).T, np.array(self.b).T
        q = np.array(self.q0) + sin @ (a / omega_i) - cos @ (b / omega_i)
        return Samples(t, q, cos @ a + sin @ b, cos @ (b * omega_i) - sin @ (a * omega_i))

    def to_dict(self) -> dict[str, Any]:
        """Return the series as a JSON object."""
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
    """Return i·ω as a column (H, 1), and sin and cos of i·ω·t (N, H), shared by all joints."""
    omega_i = 2 * np.pi * fundamental_hz * np.arange(1.0, harmonics + 1)[:, None]
    phase: FloatArray = _grid(periods / fundamental_hz, rate_hz)[:, None] * omega_i.T
    return omega_i, np.sin(phase), np.cos(phase)


@dataclass(frozen=True, slots=True)
class Hold:
    """Constant set-point `q` [rad]; the dwell rule determines the time for which `q` is held."""

    q: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Duration of the set-point [s]: zero, because the dwell rule determines its length."""
        return 0.0

    @property
    def q_start(self) -> FloatArray:
        """Position (n,) [rad]."""
        return np.array(self.q)

    @property
    def q_end(self) -> FloatArray:
        """Position (n,) [rad]."""
        return np.array(self.q)

    def sample(self, rate_hz: float) -> Samples:
        """Return the single set-point of the motion."""
        q = np.array([self.q])
        return Samples(np.zeros(1), q, np.zeros_like(q), np.zeros_like(q))

    def to_dict(self) -> dict[str, Any]:
        """Return the motion as a JSON object."""
        return {"kind": "hold", "q_rad": list(self.q)}


def motion_from_dict(raw: dict[str, Any]) -> Motion:
    """Return the motion described by a JSON object; the inverse of `Motion.to_dict`.

    Raises:
        PlanError: This version of hil does not know a motion of that `kind`.
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
        f"the plan contains a motion of kind {raw.get('kind')!r}, which this version of hil does "
        "not support",
        hint="create the plan again with this version of hil",
    )


LONGEST_S = 7600.0
"""Longest duration for which Ruckig guarantees its precision [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Motion profile of seven phases with constant jerk.

    Attributes:
        t: (7,) start times of the phases [s].
        duration_s: End time of the last phase [s].
        coefficients: (7, 4) position, velocity, half of the acceleration and a sixth of the jerk at
            the start of each phase.
    """

    t: FloatArray
    duration_s: float
    coefficients: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, velocity and acceleration, each (N,), at `t` (N,) in [0, duration]."""
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
    """Return the fastest profile from 0 to `distance` > 0 within the three limits of motion.

    The distance may have any unit; the limits must use this unit and seconds.

    Raises:
        PlanError: Ruckig finds no profile, for example because of an extreme limit, or the motion
            would take longer than `LONGEST_S`.
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
