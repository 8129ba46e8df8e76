"""Hand guiding: the drives compensate gravity and most of the dry friction (static paper, I).

An operator feels little of the arm if the drives apply the static effort predicted by the model,
plus a share of the friction in the direction of the joint motion:

    effort = (gravity(q) + load(q)) / K + offset + share · friction / K · ramp(qd)

`ramp` is 0 within a dead band, rises smoothly and is ±1 from `full_speed` on.

**Why the share is below 1.** Friction removes the power F·|qd| from a joint, and the friction
compensation adds at most the power share·F_model·|qd|. As long as share·F_model < F, the sum of the
two powers is negative at every speed. With a negative power balance the arm cannot drive itself,
whatever the operator, the noise or the delay of the controller do, and the arm comes to rest when
it is released. The modelled friction F_model differs from the real friction F for three reasons. A
straight line that is fitted to viscous friction, which is steepest at low speed, has a too large
intercept (on the arms of the mock robot, `rigid-wls` identifies 1.1 to 1.9 times the dry friction).
Warm joints have less friction (about 0.4 % per kelvin). Friction changes when the gears wear. Half
of 1.9 times the dry friction is still below the real friction, so that the default share is 0.5. If
the friction comes from a type test or a measurement at low speed, a share of 0.7 is safe. Friction
is not compensated within the dead band: a static joint keeps all of its stick friction, which holds
the arm against gravity errors of the model.

**Low-pass filter of the velocity** (`LowPass`, cutoff frequency 10 Hz). With unfiltered velocities
at 1 kHz, the wrists of the mock robot do not come to rest: they oscillate by one millirad at 20 to
30 Hz. Over a distance of one millirad, friction acts mostly like a spring, which removes no power,
so that the argument about the share does not hold.

**Forces felt by the operator.** The operator feels the full stick friction until a joint moves.
While the joint moves, the operator feels 1 − share of the dry friction, all of the viscous friction
and the inertia. A moving joint continues to move by itself if the gravity error of the model
exceeds `drift_margin`.

Gravity is computed in every control cycle, so that `GravityChain` uses fast scalar arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray, SpecError
from hil.dynamics import PARAMETERS, RobotModel
from hil.estimators import (
    RobotEstimator,
    at_rest_effort,
    dry_friction,
    gravity_torque,
)
from hil.export import plain_friction


class HandGuiding:
    """Control law for hand guiding: effort per sample of an arm.

    The law has no memory.

    Args:
        model: Fitted model of any kind with a gravity part.
        payload: Payload that is mounted; requires a model that predicts torques.
        friction: (n,) dry friction [N·m]; by default the dry friction of the model.
        friction_share: Share of the dry friction that is compensated, from 0 to below 1.
        dead_band: Speed below which no friction is compensated [rad/s]; must exceed the velocity
            noise at rest.
        full_speed: Speed from which the whole share of the friction is compensated [rad/s].
        limit: (n,) maximum effort in the unit of the model; by default the torque limits of the
            robot.

    Attributes:
        joint_names: Names of the n joints.
        unit: Unit of the efforts: `A` or `N·m`.
        drift_margin: (n,) gravity error [N·m] up to which a moving joint stops by itself, if the
            friction values are correct; infinite if no friction is compensated.

    Raises:
        FitError: The model has no gravity part, or lacks the required friction or drive gains.
        SpecError: A setting is outside its allowed range.
    """

    def __init__(
        self,
        model: RobotEstimator,
        payload: Payload | None = None,
        *,
        friction: Sequence[float] | FloatArray | None = None,
        friction_share: float = 0.5,
        dead_band: float = 0.01,
        full_speed: float = 0.05,
        limit: Sequence[float] | FloatArray | None = None,
    ) -> None:
        if not 0.0 <= friction_share < 1.0:
            raise SpecError(
                f"friction_share is {friction_share!r}, but must be at least 0 and below 1",
                hint="an arm with completely compensated friction can move by itself",
            )
        if not 0.0 < dead_band < full_speed < math.inf:
            raise SpecError(
                f"dead_band {dead_band!r} and full_speed {full_speed!r} rad/s: the first must be "
                "above 0 and the second above the first"
            )
        self.joint_names = model.joint_names_
        self.unit = "A" if model.effort_kind_ == "current" else "N·m"
        self._dead_band, self._ramp = dead_band, full_speed - dead_band
        level = _friction_of(model, friction) if friction_share else np.zeros(self.n)
        scale = model.torque_scale_
        self._level: list[float] = (friction_share * level / scale).tolist()
        self._limit: list[float] = _limit_of(model, limit).tolist()
        self._per_torque: list[float] = (1.0 / scale).tolist()
        self._offset: list[float] = at_rest_effort(model, np.zeros((1, self.n)))["offset"][
            0
        ].tolist()
        self._gravity, self._held = _gravity_of(model, payload), [0.0] * self.n
        left = (1.0 - friction_share) * level
        self.drift_margin: FloatArray = left if friction_share else np.full(self.n, np.inf)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def __call__(self, q: FloatArray, qd: FloatArray) -> FloatArray:
        """Return the effort (n,) for positions (n,) [rad] and velocities (n,) [rad/s]."""
        out = np.empty(self.n)
        self.write(q, qd, out)
        return out

    def write(self, q: FloatArray, qd: FloatArray, out: FloatArray) -> None:
        """Write the effort for a position and velocity into an existing array.

        The method is for loops that must not allocate memory.

        Raises:
            DataError: A position or velocity is not finite; all elements of `out` are then zero.
                The arm falls with zero effort, so that the caller must apply the brakes after a
                `DataError`.
        """
        held, speeds = self._held, qd.tolist()
        # min() and max() below would convert NaN to the full torque.
        for j, (angle, speed) in enumerate(zip(q.tolist(), speeds, strict=True)):
            if not (math.isfinite(angle) and math.isfinite(speed)):
                out[:] = 0.0
                raise DataError(
                    f"{self.joint_names[j]}: position {angle} rad, velocity {speed} rad/s",
                    hint="brake the arm: its sensor values are invalid",
                )
        self._gravity(q, held)
        for j in range(self.n):
            effort = held[j] * self._per_torque[j] + self._offset[j]
            effort += self._level[j] * self._direction(speeds[j])
            out[j] = min(self._limit[j], max(-self._limit[j], effort))

    def _direction(self, speed: float) -> float:
        """Return the smooth direction of motion, −1 to 1, which is 0 within the dead band."""
        beyond = (abs(speed) - self._dead_band) / self._ramp
        if beyond <= 0.0:
            return 0.0
        if beyond >= 1.0:
            return math.copysign(1.0, speed)
        return math.copysign(beyond * beyond * (3.0 - 2.0 * beyond), speed)


def _friction_of(
    model: RobotEstimator, friction: Sequence[float] | FloatArray | None
) -> FloatArray:
    """Return the dry friction (n,) [N·m] that is used for hand guiding.

    Raises:
        FitError: Neither the model nor the caller provides the dry friction.
        SpecError: `friction` is not a list of n values.
    """
    if friction is None:
        known = _level_of(model)
        if known is None or not known.any():
            raise FitError(
                f"the model {model.estimator} contains no dry friction",
                hint="pass it as friction=[…] in N·m, fit an estimator with a friction part "
                "(rigid-wls, static-coulomb), or set friction_share=0",
            )
        return known
    return _levels("friction", friction, len(model.joint_names_))


def _level_of(model: RobotEstimator) -> FloatArray | None:
    """Return the dry friction (n,) [N·m] of the model; None if it is unknown.

    If the model has no dry-friction parameter, the sliding friction of a dynamic model is used.
    """
    known = dry_friction(model)
    moves = any("trajectory" in kinds for kinds in model.series_kinds)
    return resting_friction(model) if known is None and moves and model.knows_gains else known


SLIDING_HZ = 100.0
"""Sample rate of the motion used to evaluate the sliding friction of a model [Hz]."""


def resting_friction(model: RobotEstimator) -> FloatArray:
    """Return the dry friction (n,) [N·m], a parameter or derived from sliding friction."""
    known = dry_friction(model)
    return plain_friction(model, SLIDING_HZ)[0] if known is None else known


def _levels(name: str, values: Sequence[float] | FloatArray, n: int) -> FloatArray:
    levels = np.asarray(values, dtype=np.float64)
    if levels.shape != (n,) or not np.isfinite(levels).all() or np.any(levels < 0):
        raise SpecError(f"{name} is {values!r}, but must be {n} numbers of at least 0")
    return levels


def _limit_of(model: RobotEstimator, limit: Sequence[float] | FloatArray | None) -> FloatArray:
    if limit is not None:
        return _levels("limit", limit, len(model.joint_names_))
    if not model.knows_gains:
        raise FitError(
            "the model was fitted to currents without drive gains, and torque limits in N·m do "
            "not limit currents",
            hint="pass current limits as limit=[…] in A",
        )
    most: FloatArray = model.robot_.effort_max / model.torque_scale_
    return most


def _gravity_of(
    model: RobotEstimator, payload: Payload | None
) -> Callable[[FloatArray, list[float]], None]:
    """Return a function that writes the static torque [N·m] at a position into a list.

    The static torque is caused by gravity of arm and payload.
    """
    if model.knows_gains or (payload is not None and not payload.is_empty):
        chain = GravityChain.of(model, payload)
        if chain is not None:
            return chain.write

        def from_torque(q: FloatArray, out: list[float]) -> None:
            out[:] = gravity_torque(model, q[None], payload)[0].tolist()

        return from_torque

    def from_effort(q: FloatArray, out: list[float]) -> None:
        out[:] = at_rest_effort(model, q[None])["gravity"][0].tolist()

    return from_effort


Vector = tuple[float, float, float]

Rotation = tuple[Vector, Vector, Vector]
"""Rotation matrix as a tuple of three rows."""

MOMENTS = slice(0, 4)
"""Indices of mass and first moment among the parameters of a link."""

SAMPLES = 60
"""Number of poses at which the gravity of a model is compared with its chain."""

EXACT = 1e-6
"""Maximum allowed error of the torques of a chain, as a share of the largest torque."""

IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Link(NamedTuple):
    """Joint of a chain and the link behind the joint.

    Attributes:
        turn, shift: Rotation and translation [m] of the joint frame relative to the previous frame
            at q = 0.
        axis: Joint axis in the joint frame.
        turns: Whether the joint is a rotary joint; otherwise the joint slides along its axis.
        mass: Mass of the link [kg].
        moment: First moment of the link in the joint frame [kg·m].
    """

    turn: Rotation
    shift: Vector
    axis: Vector
    turns: bool
    mass: float
    moment: Vector


class GravityChain:
    """Computation of gravity torques from the masses and first moments of links.

    Gravity torques depend on four numbers per link, its mass and its first moment. One pass from
    the base to the flange computes the link poses, and one pass back to the base sums the masses
    and moments behind each joint:

        τ_j = −g · (a_j × (H_j − M_j p_j))    turning joint
        τ_j = −g · a_j M_j                    sliding joint

    In these formulas, a_j and p_j are the axis and origin of joint j, and M_j and H_j are the mass
    and first moment of all links behind joint j, in the base frame. The code uses no matrix
    library, so that it can be translated to C line by line.

    Args:
        robot: Robot model that contains the joint geometry and the gravity vector.
        moments: (n, 4) mass [kg] and first moment [kg·m] of each link in its joint frame. Only
            combinations of masses and moments affect the torques, so that these values need not be
            the values of the real links.
    """

    def __init__(self, robot: RobotModel, moments: FloatArray) -> None:
        geometry = robot.joint_geometry()
        self.links = tuple(
            Link(
                turn=_rows(place),
                shift=_vector(place[:3, 3]),
                axis=_vector(axis),
                turns=bool(turns),
                mass=float(own[0]),
                moment=_vector(own[1:]),
            )
            for place, axis, turns, own in zip(
                geometry.placement, geometry.axis, geometry.turns, moments, strict=True
            )
        )
        self.gravity = _vector(robot.gravity_vector)

    @classmethod
    def of(cls, model: RobotEstimator, payload: Payload | None = None) -> GravityChain | None:
        """Return the chain with the gravity of a model and its payload.

        The function returns None if no chain has the gravity torques of the model.

        A chain exists for every model of a rigid body. Joint models that were fitted independently
        (eq. 15 of the static paper) are not consistent with a chain.

        Raises:
            FitError: The model has no gravity part, or cannot predict torques.
        """
        robot = model.robot_
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (SAMPLES, robot.n))
        columns = robot.gravity_regressor(q).reshape(-1, robot.n, len(PARAMETERS))[:, :, MOMENTS]
        columns = columns.reshape(len(columns), -1)
        torque = gravity_torque(model, q, payload).ravel()
        moments = np.asarray(np.linalg.lstsq(columns, torque, rcond=1e-10)[0], dtype=np.float64)
        error = np.max(np.abs(columns @ moments - torque))
        if error > EXACT * max(np.max(np.abs(torque)), 1e-9):
            return None
        return cls(robot, moments.reshape(robot.n, -1))

    def write(self, q: FloatArray, out: list[float]) -> None:
        """Write the holding torques [N·m] at `q` (n,) [rad] into the list `out` of length n."""
        turn, at = IDENTITY, (0.0, 0.0, 0.0)
        placed = []
        for link, angle in zip(self.links, q.tolist(), strict=True):
            at = _moved(at, turn, link.shift)
            turn = _product(turn, link.turn)
            axis = _turned(turn, link.axis)
            if link.turns:
                turn = _product(turn, _about(link.axis, angle))
            else:
                at = (at[0] + angle * axis[0], at[1] + angle * axis[1], at[2] + angle * axis[2])
            placed.append((axis, at, _turned(turn, link.moment)))
        self._sum_up(placed, out)

    def _sum_up(self, placed: Sequence[tuple[Vector, Vector, Vector]], out: list[float]) -> None:
        """Compute torques from axis, origin and first moment of each link, flange to base."""
        gx, gy, gz = self.gravity
        mass = hx = hy = hz = 0.0
        for j in range(len(placed) - 1, -1, -1):
            (ax, ay, az), (px, py, pz), (mx, my, mz) = placed[j]
            own = self.links[j].mass
            mass, hx, hy, hz = (
                mass + own,
                hx + mx + own * px,
                hy + my + own * py,
                hz + mz + own * pz,
            )
            if self.links[j].turns:
                dx, dy, dz = hx - mass * px, hy - mass * py, hz - mass * pz
                out[j] = -(
                    gx * (ay * dz - az * dy) + gy * (az * dx - ax * dz) + gz * (ax * dy - ay * dx)
                )
            else:
                out[j] = -mass * (gx * ax + gy * ay + gz * az)


def _rows(pose: FloatArray) -> Rotation:
    return _vector(pose[0, :3]), _vector(pose[1, :3]), _vector(pose[2, :3])


def _vector(values: FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _moved(at: Vector, turn: Rotation, shift: Vector) -> Vector:
    x, y, z = _turned(turn, shift)
    return at[0] + x, at[1] + y, at[2] + z


def _turned(turn: Rotation, v: Vector) -> Vector:
    (a, b, c), (d, e, f), (g, h, i) = turn
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _product(one: Rotation, other: Rotation) -> Rotation:
    (a, b, c), (d, e, f), (g, h, i) = other
    (p, q, r), (s, t, u), (v, w, x) = one
    return (
        (p * a + q * d + r * g, p * b + q * e + r * h, p * c + q * f + r * i),
        (s * a + t * d + u * g, s * b + t * e + u * h, s * c + t * f + u * i),
        (v * a + w * d + x * g, v * b + w * e + x * h, v * c + w * f + x * i),
    )


def _about(axis: Vector, angle: float) -> Rotation:
    """Return the matrix of the rotation by `angle` [rad] about a unit axis (Rodrigues)."""
    x, y, z = axis
    s, c = math.sin(angle), math.cos(angle)
    k = 1.0 - c
    return (
        (c + k * x * x, k * x * y - s * z, k * x * z + s * y),
        (k * y * x + s * z, c + k * y * y, k * y * z - s * x),
        (k * z * x - s * y, k * z * y + s * x, c + k * z * z),
    )


class LowPass:
    """First-order low-pass filter of a signal (n,) with initial value zero.

    Args:
        cutoff_hz: Frequency at which half of the signal power passes the filter [Hz].
        rate_hz: Sample rate of the signal [Hz].

    Raises:
        SpecError: The cutoff frequency is not between 0 and half the sample rate.
    """

    def __init__(self, cutoff_hz: float, rate_hz: float) -> None:
        if not 0.0 < cutoff_hz < rate_hz / 2 < math.inf:
            raise SpecError(
                f"a cutoff of {cutoff_hz!r} Hz at {rate_hz!r} samples per second is invalid",
                hint="use a cutoff above 0 and below half the sample rate",
            )
        self._share = -math.expm1(-2 * math.pi * cutoff_hz / rate_hz)
        self._held: FloatArray | None = None

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the filtered signal (n,) after one more sample (n,)."""
        held = np.zeros_like(values) if self._held is None else self._held
        self._held = held + self._share * (values - held)
        return self._held
