"""A serial arm as plain arrays, and recursions over its links that do without Pinocchio.

The generalised momentum is for observers, which cannot have accelerations. The momentum
p = M(q) q̇ and the gradient of the kinetic energy, which is Cᵀ(q, q̇) q̇ for every C that makes
Ṁ − 2C skew, come from one walk along the arm: link velocities out, link momenta back.

With H_i the momentum of all links behind joint i, v_i the velocity of link i and S_i the joint's
axis, all as spatial vectors in frame i,

    p_i = S_i · H_i        (Cᵀ q̇)_i = (v_i × S_i) · H_i

(the latter since a joint's motion turns the velocity of everything behind it). Both are linear in
the inertial parameters, so links that cannot exist will do as long as their torques are right.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.dynamics.build import JointGeometry
from hil.dynamics.inertial import PARAMETERS

ZERO = 1e-15
"""Sines and metres below this are what is left of an exact zero."""


class Chain(NamedTuple):
    """The constants of n joints.

    The rotation from the frame before joint i into its own is constant + cosine·cos q + sine·sin q.

    Attributes:
        gravity: (3,) in the base frame [m/s²].
        turns: (n,) whether a joint turns about its axis; else it slides along it.
        axis: (n, 3) in the joint's own frame.
        constant: (n, 3, 3).
        cosine: (n, 3, 3).
        sine: (n, 3, 3).
        offset: (n, 3) where the joint's frame is at q = 0, in the frame before [m].
        slide: (n, 3) how that changes with q.
    """

    gravity: FloatArray
    turns: BoolArray
    axis: FloatArray
    constant: FloatArray
    cosine: FloatArray
    sine: FloatArray
    offset: FloatArray
    slide: FloatArray

    @classmethod
    def of(cls, geometry: JointGeometry, gravity: FloatArray) -> Chain:
        """The constants of joints under gravity (3,)."""
        axis, turns = _exact(geometry.axis), np.asarray(geometry.turns)
        fixed, offset = geometry.placement[:, :3, :3], _exact(geometry.placement[:, :3, 3])
        along = np.einsum("ia,ib->iab", axis, axis)
        across = np.array([np.cross(np.eye(3), u) for u in axis])
        # Rodrigues: u uᵀ + (1 − u uᵀ) cos q + [u]× sin q.
        turning = turns[:, None, None]
        constant, cosine, sine = (
            _exact(np.swapaxes(fixed @ part, 1, 2))
            for part in (
                np.where(turning, along, np.eye(3)),
                np.where(turning, np.eye(3) - along, 0.0),
                np.where(turning, across, 0.0),
            )
        )
        slide = np.where(turns[:, None], 0.0, _exact(np.einsum("iab,ib->ia", fixed, axis)))
        down = np.array(gravity, dtype=np.float64)
        return cls(down, turns, axis, constant, cosine, sine, offset, slide)


def _exact(values: FloatArray) -> FloatArray:
    """Without the last bit's noise about 0 and ±1; contiguous."""
    cleaned = np.where(np.abs(values) < ZERO, 0.0, values)
    near_one = np.abs(np.abs(cleaned) - 1) < ZERO
    return np.ascontiguousarray(np.where(near_one, np.sign(cleaned), cleaned))


BODY = len(PARAMETERS)

TENSOR = [[4, 5, 7], [5, 6, 8], [7, 8, 9]]
"""Where the inertia (3, 3) is among a body's parameters."""


def momentum(
    chain: Chain, parameters: FloatArray, q: FloatArray, qd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Momentum p and Cᵀq̇.

    Args:
        chain: The joints.
        parameters: (11n,) in the order of `RobotModel.parameters(rotor=True)`.
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s].

    Returns:
        p (N, n) [N·m·s] and Cᵀq̇ (N, n) [N·m].
    """
    n = q.shape[1]
    bodies, rotors = parameters[: BODY * n].reshape(n, BODY), parameters[BODY * n :]
    frames = _rotations(chain, q)
    moved = _velocities(chain, frames, q, qd)
    p, gradient = rotors * qd, np.empty_like(qd)
    linear, angular = np.zeros((len(q), 3)), np.zeros((len(q), 3))
    for i in reversed(range(n)):
        w, v = moved[i]
        own = _own(bodies[i], w, v)
        linear, angular = linear + own[0], angular + own[1]
        axis = chain.axis[i]
        p[:, i] += (angular if chain.turns[i] else linear) @ axis
        gradient[:, i] = np.sum(linear * _cross(v if chain.turns[i] else w, axis), axis=1)
        if chain.turns[i]:
            gradient[:, i] += np.sum(angular * _cross(w, axis), axis=1)
        # Row vectors times R are the inverse rotation: into the frame before.
        linear, angular = (np.einsum("sa,sab->sb", part, frames[i]) for part in (linear, angular))
        angular = angular + _cross(_origin(chain, i, q), linear)
    return p, gradient


def _rotations(chain: Chain, q: FloatArray) -> FloatArray:
    """(n, N, 3, 3) from the frame before each joint into its own."""
    cos, sin = np.cos(q.T)[..., None, None], np.sin(q.T)[..., None, None]
    turned: FloatArray = (
        chain.constant[:, None] + cos * chain.cosine[:, None] + sin * chain.sine[:, None]
    )
    return turned


def _velocities(
    chain: Chain, frames: FloatArray, q: FloatArray, qd: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Angular and linear velocity of each link's frame in itself, each (N, 3)."""
    w, v = np.zeros((len(q), 3)), np.zeros((len(q), 3))
    found = []
    for i, R in enumerate(frames):
        v = np.einsum("sab,sb->sa", R, v + _cross(w, _origin(chain, i, q)))
        w = np.einsum("sab,sb->sa", R, w)
        step = qd[:, i, None] * chain.axis[i]
        w, v = (w + step, v) if chain.turns[i] else (w, v + step)
        found.append((w, v))
    return found


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of rows; np.cross takes ten times as long for one row."""
    ax, ay, az = a.T
    bx, by, bz = b.T
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def _origin(chain: Chain, i: int, q: FloatArray) -> FloatArray:
    """(N, 3) of joint i in the frame before [m]."""
    origin: FloatArray = chain.offset[i] + q[:, i, None] * chain.slide[i]
    return origin


def _own(body: FloatArray, w: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Linear and angular momentum of one link about its frame's origin, each (N, 3)."""
    first = body[1:4]
    return body[0] * v + _cross(w, first), w @ body[TENSOR] + _cross(first, v)
