"""Recursions along an arm, compiled by numba, in scalar operations for one sample at a time.

The equations of the regressor are given in `hil.dynamics.regressor`, and the joint constants in
`hil.dynamics.chain`. The inverse dynamics follow the Newton–Euler recursion. The compiled code is
cached on disk, so the first call on a machine takes some seconds longer. Numba detects only changes
in the file of the compiled function, so all compiled steps are in this file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np
from numba import njit

from hil.core import BoolArray, FloatArray, IntArray
from hil.dynamics.chain import Chain

OMEGA, ALPHA, ACCELERATION = 0, 1, 2
"""Row numbers in the array with the motion of one link, expressed in the link's own frame."""

Compiled = TypeVar("Compiled", bound=Callable[..., None])


def compiled(function: Compiled) -> Compiled:
    """Compile a function with numba; the compiled code is cached on disk if possible."""
    try:
        return cast("Compiled", njit(function, cache=True, error_model="numpy"))
    except RuntimeError:
        return cast("Compiled", njit(function, error_model="numpy"))


def inlined(function: Compiled) -> Compiled:
    """Compile a function as an inlined part of every compiled function that calls it.

    Inlined functions run faster, and each of them is compiled only one time.
    """
    return cast("Compiled", njit(function, inline="always", error_model="numpy"))


@inlined
def turn(R: FloatArray, i: int, vectors: FloatArray, j: int) -> None:
    """Multiply row j of an array of vectors (m, 3) in place by R[i]."""
    x, y, z = vectors[j, 0], vectors[j, 1], vectors[j, 2]
    vectors[j, 0] = R[i, 0, 0] * x + R[i, 0, 1] * y + R[i, 0, 2] * z
    vectors[j, 1] = R[i, 1, 0] * x + R[i, 1, 1] * y + R[i, 1, 2] * z
    vectors[j, 2] = R[i, 2, 0] * x + R[i, 2, 1] * y + R[i, 2, 2] * z


@inlined
def add_cross(
    a: FloatArray, i: int, b: FloatArray, j: int, factor: float, out: FloatArray, k: int
) -> None:
    """Add the cross product of row i of a and row j of b, times a factor, to row k of `out`."""
    x, y, z = factor * b[j, 0], factor * b[j, 1], factor * b[j, 2]
    out[k, 0] += a[i, 1] * z - a[i, 2] * y
    out[k, 1] += a[i, 2] * x - a[i, 0] * z
    out[k, 2] += a[i, 0] * y - a[i, 1] * x


@inlined
def start(gravity: FloatArray, body: FloatArray, K: FloatArray) -> None:
    """Set the motion of the static base; gravity appears as an upward acceleration of the base."""
    for k in range(3):
        body[OMEGA, k], body[ALPHA, k], body[ACCELERATION, k] = 0.0, 0.0, -gravity[k]
        K[k, 0], K[k, 1], K[k, 2] = 0.0, 0.0, 0.0


@inlined
def curl(body: FloatArray, K: FloatArray) -> None:
    """Compute K = [α]× + [ω]×², (3, 3)."""
    wx, wy, wz = body[OMEGA, 0], body[OMEGA, 1], body[OMEGA, 2]
    ax, ay, az = body[ALPHA, 0], body[ALPHA, 1], body[ALPHA, 2]
    K[0, 0], K[0, 1], K[0, 2] = -(wy * wy + wz * wz), wx * wy - az, wx * wz + ay
    K[1, 0], K[1, 1], K[1, 2] = wx * wy + az, -(wx * wx + wz * wz), wy * wz - ax
    K[2, 0], K[2, 1], K[2, 2] = wx * wz - ay, wy * wz + ax, -(wx * wx + wy * wy)


@inlined
def place(
    offset: FloatArray,
    slide: FloatArray,
    rotations: tuple[FloatArray, FloatArray, FloatArray],
    i: int,
    q: float,
    R: FloatArray,
    origin: FloatArray,
) -> None:
    """Compute the origin of joint i in the previous frame, and the rotation to its own frame."""
    constant, cosine, sine = rotations
    cos, sin = np.cos(q), np.sin(q)
    for k in range(3):
        origin[i, k] = offset[i, k] + slide[i, k] * q
        for m in range(3):
            R[i, k, m] = constant[i, k, m] + cos * cosine[i, k, m] + sin * sine[i, k, m]


@inlined
def carry(
    turns: BoolArray,
    axis: FloatArray,
    i: int,
    qd: float,
    qdd: float,
    R: FloatArray,
    origin: FloatArray,
    body: FloatArray,
    K: FloatArray,
) -> None:
    """Compute the motion and the matrix K of link i from those of the previous link."""
    for k in range(3):
        body[ACCELERATION, k] += (
            K[k, 0] * origin[i, 0] + K[k, 1] * origin[i, 1] + K[k, 2] * origin[i, 2]
        )
    for row in range(3):
        turn(R, i, body, row)
    if turns[i]:
        add_cross(body, OMEGA, axis, i, qd, body, ALPHA)
        for k in range(3):
            body[OMEGA, k] += axis[i, k] * qd
            body[ALPHA, k] += axis[i, k] * qdd
    else:
        add_cross(body, OMEGA, axis, i, 2.0 * qd, body, ACCELERATION)  # Coriolis
        for k in range(3):
            body[ACCELERATION, k] += axis[i, k] * qdd
    curl(body, K)


@inlined
def columns(
    body: FloatArray, K: FloatArray, w: FloatArray, v: FloatArray, j: int, row: FloatArray
) -> None:
    """Compute the effect of the ten parameters of a link on the torque of joint j.

    At unit speed, joint j moves the link with the angular velocity w and the linear velocity v.
    """
    a0, a1, a2 = body[ACCELERATION, 0], body[ACCELERATION, 1], body[ACCELERATION, 2]
    w0, w1, w2, v0, v1, v2 = w[j, 0], w[j, 1], w[j, 2], v[j, 0], v[j, 1], v[j, 2]
    x = w0 * 0.5 * (K[1, 2] + K[2, 1])
    y = w1 * 0.5 * (K[0, 2] + K[2, 0])
    z = w2 * 0.5 * (K[0, 1] + K[1, 0])
    row[0] = v0 * a0 + v1 * a1 + v2 * a2
    row[1] = v0 * K[0, 0] + v1 * K[1, 0] + v2 * K[2, 0] + a1 * w2 - a2 * w1
    row[2] = v0 * K[0, 1] + v1 * K[1, 1] + v2 * K[2, 1] + a2 * w0 - a0 * w2
    row[3] = v0 * K[0, 2] + v1 * K[1, 2] + v2 * K[2, 2] + a0 * w1 - a1 * w0
    row[4] = w0 * body[ALPHA, 0] + y - z
    row[5] = w1 * K[2, 1] - w0 * K[2, 0] + w2 * (K[0, 0] - K[1, 1])
    row[6] = w1 * body[ALPHA, 1] + z - x
    row[7] = w0 * K[1, 0] - w2 * K[1, 2] + w1 * (K[2, 2] - K[0, 0])
    row[8] = w2 * K[0, 2] - w1 * K[0, 1] + w0 * (K[1, 1] - K[2, 2])
    row[9] = w2 * body[ALPHA, 2] + x - y


@compiled
def fill_regressor(
    chain: Chain,
    q: FloatArray,
    qd: FloatArray,
    qdd: FloatArray,
    first: IntArray,
    kinds: IntArray,
    out: FloatArray,
) -> None:
    """Fill the array `out` (N, n, k) with the regressor.

    The columns first[i] to first[i + 1] belong to those parameters of link i that `kinds` lists.
    """
    n = q.shape[1]
    # Unpacked, because numba would look up tuple entries again for every sample.
    gravity, turns, axis, constant, cosine, sine, offset, slide = chain
    rotations = (constant, cosine, sine)
    w, v, body = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((3, 3))
    R, K, origin, row = np.zeros((n, 3, 3)), np.zeros((3, 3)), np.zeros((n, 3)), np.zeros(10)
    for s in range(len(q)):
        start(gravity, body, K)
        for i in range(n):
            place(offset, slide, rotations, i, q[s, i], R, origin)
            carry(turns, axis, i, qd[s, i], qdd[s, i], R, origin, body, K)
            for j in range(i):
                add_cross(w, j, origin, i, 1.0, v, j)
                turn(R, i, w, j)
                turn(R, i, v, j)
            for k in range(3):
                w[i, k] = axis[i, k] if turns[i] else 0.0
                v[i, k] = axis[i, k] - w[i, k]
            for j in range(i + 1):
                columns(body, K, w, v, j, row)
                for c in range(first[i], first[i + 1]):
                    out[s, j, c] = row[kinds[c]]


@inlined
def wrench(
    p: FloatArray, i: int, body: FloatArray, K: FloatArray, f: FloatArray, t: FloatArray
) -> None:
    """Compute force and torque about the frame origin of link i from its parameters p[i] (10,)."""
    a0, a1, a2 = body[ACCELERATION, 0], body[ACCELERATION, 1], body[ACCELERATION, 2]
    w0, w1, w2 = body[OMEGA, 0], body[OMEGA, 1], body[OMEGA, 2]
    l0, l1, l2 = body[ALPHA, 0], body[ALPHA, 1], body[ALPHA, 2]
    c0, c1, c2 = p[i, 1], p[i, 2], p[i, 3]
    for k in range(3):
        f[i, k] = p[i, 0] * body[ACCELERATION, k] + K[k, 0] * c0 + K[k, 1] * c1 + K[k, 2] * c2
    h0 = p[i, 4] * w0 + p[i, 5] * w1 + p[i, 7] * w2
    h1 = p[i, 5] * w0 + p[i, 6] * w1 + p[i, 8] * w2
    h2 = p[i, 7] * w0 + p[i, 8] * w1 + p[i, 9] * w2
    t[i, 0] = p[i, 4] * l0 + p[i, 5] * l1 + p[i, 7] * l2 + w1 * h2 - w2 * h1 + c1 * a2 - c2 * a1
    t[i, 1] = p[i, 5] * l0 + p[i, 6] * l1 + p[i, 8] * l2 + w2 * h0 - w0 * h2 + c2 * a0 - c0 * a2
    t[i, 2] = p[i, 7] * l0 + p[i, 8] * l1 + p[i, 9] * l2 + w0 * h1 - w1 * h0 + c0 * a1 - c1 * a0


@inlined
def turn_back(R: FloatArray, i: int, vectors: FloatArray) -> None:
    """Multiply row i of an array of vectors (n, 3) in place by the inverse of R[i]."""
    x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
    for k in range(3):
        vectors[i, k] = R[i, 0, k] * x + R[i, 1, k] * y + R[i, 2, k] * z


@compiled
def fill_torques(
    chain: Chain,
    q: FloatArray,
    qd: FloatArray,
    qdd: FloatArray,
    parameters: FloatArray,
    rotor: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (N, n) with the joint torques of links with parameters (n, 10) and rotors (n,)."""
    n = q.shape[1]
    # Unpacked, because numba would look up tuple entries again for every sample.
    gravity, turns, axis, constant, cosine, sine, offset, slide = chain
    rotations = (constant, cosine, sine)
    body, f, t = np.zeros((3, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    R, K, origin = np.zeros((n, 3, 3)), np.zeros((3, 3)), np.zeros((n, 3))
    for s in range(len(q)):
        start(gravity, body, K)
        for i in range(n):
            place(offset, slide, rotations, i, q[s, i], R, origin)
            carry(turns, axis, i, qd[s, i], qdd[s, i], R, origin, body, K)
            wrench(parameters, i, body, K, f, t)
        for i in range(n - 1, -1, -1):
            felt = t if turns[i] else f
            along = axis[i, 0] * felt[i, 0] + axis[i, 1] * felt[i, 1] + axis[i, 2] * felt[i, 2]
            out[s, i] = along + rotor[i] * qdd[s, i]
            turn_back(R, i, f)
            turn_back(R, i, t)
            add_cross(origin, i, f, i, 1.0, t, i)
            for k in range(3):
                if i:
                    f[i - 1, k] += f[i, k]
                    t[i - 1, k] += t[i, k]
