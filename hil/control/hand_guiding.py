"""Leading an arm by hand: drives carry its weight and most of its dry friction (static paper, I).

What a drive has to give so that a person feels little of the arm is what the model says about it at
rest, plus a share of the friction in the direction in which the joint moves:

    effort = (gravity(q) + load(q)) / K + offset + share · friction / K · ramp(qd)

`ramp` is 0 within a dead band, rises smoothly and is ±1 from `full_speed` on.

**Why the share is below 1.** Friction takes the power F·|qd| out of a joint, the compensation
puts at most share·F_model·|qd| into it. As long as share·F_model < F the sum is negative at every
speed: the arm cannot drive itself, whatever the hand, the noise or the delay of the controller do,
and it comes to rest when it is let go. F_model is not F: a straight line through viscous friction
that is steepest at low speed meets the axis too high (on the mock's arms `rigid-wls` finds 1.1 to
1.9 times the dry friction), warm joints have less (some 0.4 % per kelvin), and it changes with
wear. Half of 1.9 is still below 1, hence the default. With the friction of a type test or a
measurement at low speed 0.7 is safe. Nothing is compensated within the dead band: a joint at rest
keeps all of its stick friction, which holds what the model does not know of gravity.

**Low-pass the velocity** (`LowPass`, 10 Hz). Fed with velocities as they are measured at 1 kHz,
wrists of the mock do not come to rest: they tremble by a millirad at 20 to 30 Hz. Over so short a
way friction is much of a spring, which takes no power out: the argument above fails.

**What a person feels.** All of the stick friction until a joint moves, then 1 − share of the dry
friction, all of the viscous friction and the inertia. A joint that moves drifts on by itself where
gravity is wrong by more than `drift_margin`.

Gravity is computed every cycle, so `GravityChain` has it in plain arithmetic.
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
    """Effort per sample that lets an arm be led by hand; it has no memory.

    Args:
        model: Any fitted model with a gravity part.
        payload: What is mounted; needs a model that knows torques.
        friction: (n,) dry friction [N·m]; by default the model's.
        friction_share: How much of it is compensated, from 0 to below 1.
        dead_band: Below this speed nothing is [rad/s]: above the noise of the velocity at rest.
        full_speed: From this speed on the whole share is [rad/s].
        limit: (n,) largest effort in the model's unit; by default the robot's torque limits.

    Attributes:
        joint_names: Length n.
        unit: `A` or `N·m`, of the efforts.
        drift_margin: (n,) error of gravity [N·m] that a moving joint stands without drifting on,
            if friction is what it was taken for; infinite where none is compensated.

    Raises:
        FitError: The model has no gravity, or lacks friction or drive gains that are needed.
        SpecError: A setting cannot be.
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
                hint="an arm whose friction is compensated wholly can drive itself",
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
        """(n,) effort for positions [rad] and velocities [rad/s] (n,); see `write`."""
        out = np.empty(self.n)
        self.write(q, qd, out)
        return out

    def write(self, q: FloatArray, qd: FloatArray, out: FloatArray) -> None:
        """The same into an array there is already, for loops that must not allocate.

        Raises:
            DataError: A position or velocity is not finite; `out` is then zeros. The arm falls
                with zeros too: whoever calls has to brake.
        """
        held, speeds = self._held, qd.tolist()
        # min() and max() below would make a full torque of NaN.
        for j, (angle, speed) in enumerate(zip(q.tolist(), speeds, strict=True)):
            if not (math.isfinite(angle) and math.isfinite(speed)):
                out[:] = 0.0
                raise DataError(
                    f"{self.joint_names[j]}: position {angle} rad, velocity {speed} rad/s",
                    hint="brake the arm: its sensors are not read",
                )
        self._gravity(q, held)
        for j in range(self.n):
            effort = held[j] * self._per_torque[j] + self._offset[j]
            effort += self._level[j] * self._direction(speeds[j])
            out[j] = min(self._limit[j], max(-self._limit[j], effort))

    def _direction(self, speed: float) -> float:
        """−1 to 1, smooth, and 0 within the dead band."""
        beyond = (abs(speed) - self._dead_band) / self._ramp
        if beyond <= 0.0:
            return 0.0
        if beyond >= 1.0:
            return math.copysign(1.0, speed)
        return math.copysign(beyond * beyond * (3.0 - 2.0 * beyond), speed)


def _friction_of(
    model: RobotEstimator, friction: Sequence[float] | FloatArray | None
) -> FloatArray:
    """(n,) dry friction [N·m].

    Raises:
        FitError: Neither the model nor anybody else says it.
        SpecError: It is no list of n levels.
    """
    if friction is None:
        known = _level_of(model)
        if known is None or not known.any():
            raise FitError(
                f"the model {model.estimator} does not know the dry friction",
                hint="give it as friction=[…] in N·m, fit an estimator with a friction part "
                "(rigid-wls, static-coulomb), or set friction_share=0",
            )
        return known
    return _levels("friction", friction, len(model.joint_names_))


def _level_of(model: RobotEstimator) -> FloatArray | None:
    """(n,) what the model says, or what its sliding friction shows; None of an arm at rest only."""
    known = dry_friction(model)
    moves = any("trajectory" in kinds for kinds in model.series_kinds)
    return resting_friction(model) if known is None and moves and model.knows_gains else known


SLIDING_HZ = 100.0
"""Samples of the motion at which a model is asked for friction that slides."""


def resting_friction(model: RobotEstimator) -> FloatArray:
    """(n,) dry friction of a model [N·m]: its own parameter, or what its sliding friction shows."""
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
            "the model was fitted to currents without drive gains: its robot's torque limits are "
            "no limits of currents",
            hint="give them as limit=[…] in A",
        )
    most: FloatArray = model.robot_.effort_max / model.torque_scale_
    return most


def _gravity_of(
    model: RobotEstimator, payload: Payload | None
) -> Callable[[FloatArray, list[float]], None]:
    """Writes gravity and load [N·m] at a position (n,) into a list of n numbers."""
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
"""Three rows."""

MOMENTS = slice(0, 4)
"""Mass and first moment among the parameters of a link."""

SAMPLES = 60
"""Poses at which a model is compared with its chain."""

EXACT = 1e-6
"""Largest error of a chain that stands for a model, as a share of the largest torque."""

IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Link(NamedTuple):
    """A joint and the link behind it.

    Attributes:
        turn, shift: Placement of the joint's frame in the one before, at q = 0 [m].
        axis: Of the joint, in its own frame.
        turns: Whether it turns about its axis or slides along it.
        mass: Of the link [kg].
        moment: First moment of the link in the joint's frame [kg·m].
    """

    turn: Rotation
    shift: Vector
    axis: Vector
    turns: bool
    mass: float
    moment: Vector


class GravityChain:
    """Gravity torques from the first moments of links.

    Gravity knows four numbers of a link, its mass and its first moment. With those of a chain, one
    walk from the base to the flange places the links and one walk back sums up what hangs on each
    joint:

        τ_j = −g · (a_j × (H_j − M_j p_j))    turning joint
        τ_j = −g · a_j M_j                    sliding joint

    with a_j and p_j axis and origin of joint j, M_j and H_j mass and first moment of everything
    behind it, all in the base frame. There is no matrix library in it, so that it can become C line
    by line.

    Args:
        robot: Says where the joints are and where gravity points.
        moments: (n, 4) mass [kg] and first moment [kg·m] of each link in its joint's frame. Only
            combinations of them show in torques, so they need not be those of the real links.
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
        """The chain with the gravity of a model and its load; None where there is none.

        There is one for every model of a rigid body. Joints that were fitted each by itself
        (eq. 15 of the static paper) agree on no chain.

        Raises:
            FitError: The model has no gravity, or cannot tell torques.
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
        """Write the torques [N·m] that hold the arm at `q` (n,) [rad] into `out`, n numbers."""
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
        """From axis, origin and first moment of each link to torques, flange to base."""
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
    """Rotation by `angle` [rad] about an axis of length 1 (Rodrigues)."""
    x, y, z = axis
    s, c = math.sin(angle), math.cos(angle)
    k = 1.0 - c
    return (
        (c + k * x * x, k * x * y - s * z, k * x * z + s * y),
        (k * y * x + s * z, c + k * y * y, k * y * z - s * x),
        (k * z * x - s * y, k * z * y + s * x, c + k * z * z),
    )


class LowPass:
    """What is slow in a signal (n,); it begins at zero.

    Args:
        cutoff_hz: Where half of the power is left.
        rate_hz: Of the samples.

    Raises:
        SpecError: The cutoff is not between 0 and half the rate.
    """

    def __init__(self, cutoff_hz: float, rate_hz: float) -> None:
        if not 0.0 < cutoff_hz < rate_hz / 2 < math.inf:
            raise SpecError(
                f"a cutoff of {cutoff_hz!r} Hz at {rate_hz!r} samples a second cannot be",
                hint="it must be above 0 and below half the rate",
            )
        self._share = -math.expm1(-2 * math.pi * cutoff_hz / rate_hz)
        self._held: FloatArray | None = None

    def __call__(self, values: FloatArray) -> FloatArray:
        """(n,) the filtered signal after one more sample (n,)."""
        held = np.zeros_like(values) if self._held is None else self._held
        self._held = held + self._share * (values - held)
        return self._held
