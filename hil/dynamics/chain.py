"""Constants of a serial arm as arrays, and recursions over its links without Pinocchio.

The generalised momentum is needed by observers, for which accelerations are not available. One
recursion along the arm computes the momentum p = M(q) q̇ and the gradient of the kinetic energy.
The gradient of the kinetic energy is Cᵀ(q, q̇) q̇ for every matrix C for which Ṁ − 2C is
skew-symmetric. Link velocities are computed from the base outwards, link momenta from the tip
inwards.

H_i is the momentum of link i and all links after it, v_i the velocity of link i and S_i the axis of
joint i, all as spatial vectors in frame i. Then

    p_i = S_i · H_i        (Cᵀ q̇)_i = (v_i × S_i) · H_i

The second equation holds because a joint rotates the velocities of all links after this joint.
Momentum and gradient are linear in the inertial parameters, so the links need not be physically
consistent as long as their torques are correct.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.dynamics.build import JointGeometry
from hil.dynamics.inertial import PARAMETERS

ZERO = 1e-15
"""Absolute value below which sines and lengths in m are treated as rounding errors of an exact
zero.
"""


class Chain(NamedTuple):
    """Constants of n joints.

    The rotation from the frame before joint i to the frame of joint i is `constant` + `cosine`·cos
    q + `sine`·sin q.

    Attributes:
        gravity: (3,) gravity vector in the base frame [m/s²].
        turns: (n,) flags; true if the joint is revolute, false if it is prismatic.
        axis: (n, 3) joint axes in the joint frames.
        constant: (n, 3, 3) constant part of the rotation between the frames.
        cosine: (n, 3, 3) factor of cos q in the rotation.
        sine: (n, 3, 3) factor of sin q in the rotation.
        offset: (n, 3) origin of the joint frame at q = 0, in the previous joint frame [m].
        slide: (n, 3) change of the origin of the joint frame per unit of q.
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
        """Return the constants of joints that have this geometry and gravity vector (3,)."""
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
    """Return contiguous values from which rounding errors near 0 and ±1 are removed."""
    cleaned = np.where(np.abs(values) < ZERO, 0.0, values)
    near_one = np.abs(np.abs(cleaned) - 1) < ZERO
    return np.ascontiguousarray(np.where(near_one, np.sign(cleaned), cleaned))


BODY = len(PARAMETERS)

TENSOR = [[4, 5, 7], [5, 6, 8], [7, 8, 9]]
"""Indices of the elements of the inertia (3, 3) within the parameters of a body."""


def momentum(
    chain: Chain, parameters: FloatArray, q: FloatArray, qd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the generalised momentum p and the gradient Cᵀq̇ of the kinetic energy.

    Args:
        chain: Constants of the joints of the arm.
        parameters: (11n,) inertial parameters in the order of `RobotModel.parameters(rotor=True)`.
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
        # Row vectors times R give the inverse rotation, into the previous frame.
        linear, angular = (np.einsum("sa,sab->sb", part, frames[i]) for part in (linear, angular))
        angular = angular + _cross(_origin(chain, i, q), linear)
    return p, gradient


def _rotations(chain: Chain, q: FloatArray) -> FloatArray:
    """Return the rotations (n, N, 3, 3) from the previous frame to the frame of each joint."""
    cos, sin = np.cos(q.T)[..., None, None], np.sin(q.T)[..., None, None]
    turned: FloatArray = (
        chain.constant[:, None] + cos * chain.cosine[:, None] + sin * chain.sine[:, None]
    )
    return turned


def _velocities(
    chain: Chain, frames: FloatArray, q: FloatArray, qd: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return angular and linear velocity of each link in the link's own frame, each (N, 3)."""
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
    """Return the cross products of rows; np.cross takes ten times as long for a single row."""
    ax, ay, az = a.T
    bx, by, bz = b.T
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)


def _origin(chain: Chain, i: int, q: FloatArray) -> FloatArray:
    """Return the origin (N, 3) of the frame of joint i in the previous frame [m]."""
    origin: FloatArray = chain.offset[i] + q[:, i, None] * chain.slide[i]
    return origin


def _own(body: FloatArray, w: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return linear and angular momentum of one link about its frame's origin, each (N, 3)."""
    first = body[1:4]
    return body[0] * v + _cross(w, first), w @ body[TENSOR] + _cross(first, v)
