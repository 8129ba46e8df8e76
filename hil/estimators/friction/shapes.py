"""The shapes of a joint's friction: lengths, Stribeck speeds and exponents, from its data.

Each joint's backbone law, offset + Fv·v + z·(Fc + g·|τ| + Fs·exp(−|v|/vs)) + Fp·sign(v)·|v|^p, is
fitted to what the rigid body leaves, by variable projection: x₀, vs and p are searched for, with
exact derivatives, the rest is linear. Columns and derivatives pass the same filter as the target.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.motion import FrictionMotion, Shapes
from hil.estimators.friction.varpro import variable_projection

FIRST_LENGTH, FIRST_STRIBECK, FIRST_POWER = 2e-4, 0.1, 0.35
LOWEST = np.array([np.log(3e-5), np.log(0.02), 0.15])
HIGHEST = np.array([np.log(3e-3), np.log(0.5), 0.85])
"""Bounds of log x₀ [rad], log vs [rad/s] and p: beyond, a shape is another column in disguise."""

MOST_STEPS = 6

Through = Callable[[FloatArray], FloatArray]
"""Filter along axis 0, and keep every k-th row."""

Part = tuple[FrictionMotion, FloatArray, Through]
"""One series: its motion, what the rigid body leaves (rows, n), and its filter."""


def first_shapes(turns: FloatArray) -> Shapes:
    """Where the search begins; `turns` (n,) motor turns per joint turn."""
    one = np.ones(len(turns))
    return Shapes(FIRST_LENGTH * one, FIRST_STRIBECK * one, FIRST_POWER * one, turns)


def fitted_shapes(parts: list[Part], start: Shapes) -> Shapes:
    """Shapes of every joint by itself, starting from `start`."""
    found = np.array([_of_joint(parts, start, j) for j in range(len(start.length))])
    return Shapes(np.exp(found[:, 0]), np.exp(found[:, 1]), found[:, 2], start.turns)


def _of_joint(parts: list[Part], start: Shapes, j: int) -> FloatArray:
    target = np.concatenate([rest[:, j] for _, rest, _ in parts])

    def columns(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        made = [_backbone(motion, theta, j, through) for motion, _, through in parts]
        return np.concatenate([F for F, _ in made]), np.concatenate([d for _, d in made], axis=1)

    first = np.array([np.log(start.length[j]), np.log(start.stribeck[j]), start.power[j]])
    return variable_projection(columns, target, first, LOWEST, HIGHEST, most_steps=MOST_STEPS).theta


def _backbone(
    motion: FrictionMotion, theta: FloatArray, j: int, through: Through
) -> tuple[FloatArray, FloatArray]:
    """Columns (N, 6) of the backbone law of joint j and their derivatives (3, N, 6)."""
    length, stribeck, power = np.exp(theta[:1]), np.exp(theta[1:2]), theta[2:]
    one = slice(j, j + 1)
    assert motion.steps is not None
    m = FrictionMotion(
        motion.q[:, one],
        motion.v[:, one],
        motion.transmitted[:, one],
        Shapes(length, stribeck, power, motion.shapes.turns[one]),
        motion.steps[:, one],
    )
    z, slope, peak, law = m.z, m.state_slope(), m.peak(), m.law(power)
    by_stribeck = z * peak * m.speed / stribeck
    by_power = law * np.log(np.maximum(m.speed, 1e-12))
    columns = [np.ones_like(z), m.v, z, z * m.load, z * peak, law]
    slopes = [slope, slope * m.load, slope * peak, by_stribeck, by_power]
    filtered = through(np.hstack([*columns, *slopes]))
    F, d = filtered[:, :6], np.zeros((3, len(filtered), 6))
    d[0][:, 2:5] = filtered[:, 6:9]
    d[1][:, 4], d[2][:, 5] = filtered[:, 9], filtered[:, 10]
    return F, d
