"""Inverse dynamics as numba compiles them: Newton and Euler, one sample after the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from zlib import crc32

import numpy as np

from hil.core import FloatArray
from hil.dynamics import compiled as steps
from hil.dynamics.chain import Chain
from hil.dynamics.compiled import (
    ACCELERATION,
    ALPHA,
    OMEGA,
    add_cross,
    carry,
    compiled,
    inlined,
    place,
    start,
)


@inlined
def wrench(
    p: FloatArray, i: int, body: FloatArray, K: FloatArray, f: FloatArray, t: FloatArray
) -> None:
    """Force and torque about its origin that link i with parameters p[i] (10,) needs."""
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
    """Turn row i of vectors (n, 3) in place by the inverse of R[i]."""
    x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
    for k in range(3):
        vectors[i, k] = R[i, 0, k] * x + R[i, 1, k] * y + R[i, 2, k] * z


def _entry(stamp: int) -> Callable[..., None]:
    """Closing over the stamp puts it into the key under which numba keeps the compiled code."""

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
        """Joint torques (N, n) of links with parameters (n, 10) and rotors (n,)."""
        n = q.shape[1] if stamp >= 0 else 0
        # Arrays by themselves: what is looked up in a tuple is looked up again for every sample.
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

    return fill_torques


# Numba looks for changes in this file only, and the steps are in another.
fill_torques = _entry(crc32(Path(steps.__file__).read_bytes()))
