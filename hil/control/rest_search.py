"""Local searches for poses of little torque, within limits and clear of everything.

The torques of gravity are functions of the pose with many valleys, so many searches are started
from well-spread clear poses: sequential quadratic programming (SLSQP, Kraft 1988) on the sum of
squared shares of the torque limits, with the limits of the joints and every distance as
constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from hil.control.brakes_fail import INDIFFERENT, curvatures
from hil.control.resting import RestingArm
from hil.core import BoolArray, FloatArray, PlanError

DRAWN = 4096
"""Well-spread poses that are looked at; a power of two."""

STARTS = 24
"""Local searches, a multiple of three."""

LIGHT = 256
"""Of the poses looked at, so many of the least effort are asked whether they lie in a valley."""

SPARE_M = 1e-5
"""Kept beyond the clearance, so that rounding does not fall below it."""

FTOL = 1e-8
"""A search ends when percent squared, or squared radians, change by less."""

Cost = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value and gradient (n,) at q (n,)."""


def starts_of(arm: RestingArm, seed: int) -> FloatArray:
    """(≤ STARTS, n) well-spread clear poses of little effort.

    Raises:
        PlanError: None of the poses that were looked at is clear.
    """
    from scipy.stats import qmc

    low, high = drawn_range(arm)
    points = qmc.Sobol(arm.n, scramble=True, rng=np.random.default_rng(seed)).random(DRAWN)
    drawn = low + points * (high - low)
    clear = drawn[arm.is_clear(drawn)]
    if len(clear) == 0:
        raise none_clear(arm, drawn)
    clear = clear[np.argsort(arm.effort(clear), kind="stable")]
    # A third are the best, a third lie in the roundest valleys of the potential energy, where the
    # arm hangs; the others keep the search from seeing one valley only.
    third = STARTS // 3
    spread = clear[third :: max(1, len(clear) // third)][:third]
    return np.concatenate([clear[:third], _in_valleys(arm, clear[:LIGHT], third), spread])


def _in_valleys(arm: RestingArm, poses: FloatArray, count: int) -> FloatArray:
    """(≤ count, n) of the `poses` (N, n) those whose least curvature is largest."""
    least = np.array([curvatures(arm, q)[0][0] for q in poses])
    return poses[np.argsort(-least, kind="stable")[:count]]


def free_joints(arm: RestingArm, q: FloatArray) -> BoolArray:
    """(n,) joints that no torque depends on, judged at `q` (N, n): turning them changes nothing."""
    slopes = np.array([arm.stiffness(pose) / arm.limit[:, None] for pose in q])
    return np.asarray(np.abs(slopes).max(axis=(0, 1)) < INDIFFERENT)


def turned(arm: RestingArm, q: FloatArray, free: BoolArray, wanted: FloatArray) -> FloatArray:
    """The pose `q` (n,) with its free joints at `wanted` (n,), wherever that is clear."""
    for joint in np.flatnonzero(free):
        other = q.copy()
        other[joint] = np.clip(wanted[joint], arm.low[joint], arm.high[joint])
        q = other if arm.is_clear(other[None])[0] else q
    return q


def drawn_range(arm: RestingArm) -> tuple[FloatArray, FloatArray]:
    """Range (n,), (n,) that holds every pose once: one turn about 0 where the limits allow more."""
    centre = np.clip(0.0, arm.low + np.pi, np.maximum(arm.high - np.pi, arm.low + np.pi))
    centre = np.where(np.isfinite(centre), centre, 0.0)
    return np.maximum(arm.low, centre - np.pi), np.minimum(arm.high, centre + np.pi)


def least_effort(arm: RestingArm, start: FloatArray) -> FloatArray:
    """The pose (n,) of least effort that is reached from `start` (n,)."""
    return _search(arm, start, lambda q: _effort_cost(arm, q))


def nearest_within(
    arm: RestingArm, near: FloatArray, effort: float, starts: Iterable[FloatArray]
) -> list[FloatArray]:
    """The poses (n,) nearest to `near` with at most that effort that are reached from `starts`."""
    bound = {
        "type": "ineq",
        "fun": lambda q: arm.n * (100 * effort) ** 2 - _effort_cost(arm, q)[0],
        "jac": lambda q: -_effort_cost(arm, q)[1],
    }

    def cost(q: FloatArray) -> tuple[float, FloatArray]:
        return float(np.sum((q - near) ** 2)), 2.0 * (q - near)

    return [_search(arm, np.clip(start, arm.low, arm.high), cost, bound) for start in starts]


def _effort_cost(arm: RestingArm, q: FloatArray) -> tuple[float, FloatArray]:
    """Sum of squared shares in percent, and its gradient."""
    torque, stiffness = arm.torque_and_stiffness(q)
    percent = 100.0 * torque / arm.limit
    slopes = 100.0 * stiffness / arm.limit[:, None]
    return float(percent @ percent), 2.0 * slopes.T @ percent


def _search(arm: RestingArm, start: FloatArray, cost: Cost, *constraints: Any) -> FloatArray:
    """The local optimum (n,) that SLSQP finds from `start` (n,)."""
    from scipy.optimize import minimize

    if arm.around is not None:
        room = {"fun": lambda q: arm.room(q) - SPARE_M, "jac": arm.room_slopes}
        constraints = (*constraints, {"type": "ineq", **room})
    done = minimize(
        cost,
        start,
        jac=True,
        method="SLSQP",
        bounds=list(zip(arm.low, arm.high, strict=True)),
        constraints=constraints,
        options={"maxiter": 100, "ftol": FTOL},
    )
    reached: FloatArray = np.clip(np.asarray(done.x), arm.low, arm.high)
    return reached


def none_clear(arm: RestingArm, looked_at: FloatArray) -> PlanError:
    """The error that says how far from clear the poses `looked_at` (N, n) are."""
    distances = [arm.closest(q) for q in looked_at[:256]]
    roomiest, (a, b) = max(distances)
    return PlanError(
        f"none of the poses looked at keeps {1e3 * arm.clearance_m:.0f} mm clear; the roomiest has "
        f"{1e3 * roomiest:.0f} mm between {a} and {b}",
        hint="ask for less with --clearance-mm, or see whether the station's surroundings are as "
        "described",
    )
