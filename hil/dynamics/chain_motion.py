"""Where the links of a chain are and how they move, for many samples at once.

Twists and wrenches are Plücker coordinates in base axes about the base's origin, as arrays
(2, 3, …): linear before angular. Samples come last, so that every operation runs over long rows.
Notation of Featherstone 2008: `a` includes the acceleration −g of the base.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.dynamics.build import JointGeometry


@dataclass(frozen=True, slots=True, eq=False)
class ChainMotion:
    """The motion of n links at N samples.

    Attributes:
        R: (3, 3, n, N) orientation of the joints' frames in the base.
        p: (3, n, N) their origins.
        J: (2, 3, n, N) twist per unit of joint speed.
        J_dot: (2, 3, n, N) its derivative by time.
        v, a: (2, 3, n, N) twists of the links and their spatial accelerations.
    """

    R: FloatArray
    p: FloatArray
    J: FloatArray
    J_dot: FloatArray
    v: FloatArray
    a: FloatArray


def chain_motion(
    geometry: JointGeometry, gravity: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> ChainMotion:
    """Forward kinematics of a chain.

    Args:
        geometry: Of its joints.
        gravity: (3,) in the base frame [m/s²].
        q: (n, N) joint positions; `qd` and `qdd` are like it.
        qd: Velocities.
        qdd: Accelerations.
    """
    R, p, J = _frames(geometry, q)
    v = np.cumsum(J * qd, axis=2)
    J_dot = twist_cross(v, J)
    a = np.cumsum(J * qdd + J_dot * qd, axis=2)
    a[0] -= gravity[:, None, None]
    return ChainMotion(R, p, J, J_dot, v, a)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """A × b along the first axis, (3, …)."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a[1] * b[2], a[2] * b[1], out=out[0])
    np.subtract(a[2] * b[0], a[0] * b[2], out=out[1])
    np.subtract(a[0] * b[1], a[1] * b[0], out=out[2])
    return out


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """A · b along the first axis, (3, …)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def power(twist: FloatArray, wrench: FloatArray) -> FloatArray:
    """What a wrench does along a twist, (2, 3, …) each."""
    return dot(twist[0], wrench[0]) + dot(twist[1], wrench[1])


def twist_cross(x: FloatArray, y: FloatArray) -> FloatArray:
    """X × y of two twists (2, 3, …)."""
    return np.stack([cross(x[1], y[0]) + cross(x[0], y[1]), cross(x[1], y[1])])


def wrench_cross(x: FloatArray, w: FloatArray) -> FloatArray:
    """X ×* w of a twist and a wrench (2, 3, …): y · (x ×* w) = −(x × y) · w."""
    return np.stack([cross(x[1], w[0]), cross(x[1], w[1]) + cross(x[0], w[0])])


def rotate(R: FloatArray, x: FloatArray) -> FloatArray:
    """R x for matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[:, 0] * x[0] + R[:, 1] * x[1] + R[:, 2] * x[2])


def rotate_back(R: FloatArray, x: FloatArray) -> FloatArray:
    """Rᵀ x for matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[0] * x[0] + R[1] * x[1] + R[2] * x[2])


def _frames(geometry: JointGeometry, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R, p and J of `ChainMotion`."""
    n, N = q.shape
    R, p, J = np.empty((3, 3, n, N)), np.empty((3, n, N)), np.zeros((2, 3, n, N))
    turn, origin = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, N)), np.zeros((3, N))
    for i in range(n):
        pose, axis = geometry.placement[i], geometry.axis[i]
        origin = origin + np.einsum("abk,b->ak", turn, pose[:3, 3])
        turn = np.einsum("abk,bc->ack", turn, pose[:3, :3])
        z = np.einsum("abk,b->ak", turn, axis)
        if geometry.turns[i]:
            turn = _turned(turn, axis, q[i])
            J[0, :, i], J[1, :, i] = cross(origin, z), z
        else:
            origin = origin + z * q[i]
            J[0, :, i] = z
        R[:, :, i], p[:, i] = turn, origin
    return R, p, J


def _turned(R: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    """R·Rot(axis, angle) by Rodrigues' formula, (3, 3, N)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    RK = np.einsum("abk,bc->ack", R, K)
    RKK = np.einsum("abk,bc->ack", R, K @ K)
    return np.asarray(R + np.sin(angle) * RK + (1.0 - np.cos(angle)) * RKK)
