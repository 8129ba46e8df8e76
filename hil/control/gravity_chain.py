"""Gravity of a serial chain in plain arithmetic: what a controller computes every cycle.

Gravity knows four numbers of a link, its mass and its first moment. With those of a chain, one walk
from the base to the flange places the links and one walk back sums up what hangs on each joint:

    τ_j = −g · (a_j × (H_j − M_j p_j))    turning joint
    τ_j = −g · a_j M_j                    sliding joint

with a_j and p_j axis and origin of joint j, M_j and H_j mass and first moment of everything behind
it, all in the base frame. There is no matrix library in it, so that it can become C line by line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics import PARAMETERS, RobotModel
from hil.estimators import RobotEstimator, gravity_torque

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


def _vector(values: FloatArray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _rows(pose: FloatArray) -> Rotation:
    return _vector(pose[0, :3]), _vector(pose[1, :3]), _vector(pose[2, :3])


def _turned(turn: Rotation, v: Vector) -> Vector:
    (a, b, c), (d, e, f), (g, h, i) = turn
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _moved(at: Vector, turn: Rotation, shift: Vector) -> Vector:
    x, y, z = _turned(turn, shift)
    return at[0] + x, at[1] + y, at[2] + z


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
