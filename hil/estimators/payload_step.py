"""One step to a load, and what of the model's friction is to be freed, on a linearised problem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import FitError, FloatArray, IntArray
from hil.estimators.least_squares import upper_triangle
from hil.estimators.load_body import is_body, nearest_body
from hil.estimators.payload_problem import Friction, Linearised

LOAD = 10
"""Inertial parameters of a load."""

FOLDS = 5
"""Stretches of every series that are left out in turn to choose."""

LEAST_GAIN = 0.01
"""What freeing more has to take off the error left out, as a share of its square."""


class Step(NamedTuple):
    """Where a step leads.

    Attributes:
        parameters: (10,) of the load.
        extra: (k,) coefficients of the correction.
        bounded: Whether least squares alone would leave what bodies can be.
    """

    parameters: FloatArray
    extra: FloatArray
    bounded: bool


def step(at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray) -> Step:
    """Load and correction that fit a linearised prediction best.

    Args:
        at: Linearised at `parameters` (10,).
        parameters: Where.
        target: (M, n) measured.
        sigma: (n,) standard deviations that weight the joints.

    Raises:
        FitError: The motion does not show every parameter.
    """
    return _solved(upper_triangle(_weighted(at, parameters, target, sigma)))


def best_friction(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray, offsets: IntArray
) -> Friction:
    """What of the friction to free, by the error on stretches of time that are left out in turn.

    Args:
        at: With the columns of everything that can be freed; the others as for `step`.
        parameters: Where.
        target: (M, n) measured.
        sigma: (n,) standard deviations that weight the joints.
        offsets: (S + 1,) row at which each series begins.
    """
    n = target.shape[1]
    rows = _weighted(at, parameters, target, sigma)
    number = np.repeat(_folds(offsets), n)
    triangles = [upper_triangle(rows[number == fold]) for fold in range(FOLDS)]
    k = at.friction.shape[1]
    freed: dict[Friction, list[int]] = {"model": [], "offset": list(range(0, k, max(k // n, 1)))}
    if k > n:
        freed["scale"] = list(range(k))
    best: Friction = "model"
    least = np.inf
    for name, columns in freed.items():
        error = _left_out(triangles, [*columns, *range(k, k + LOAD + 1)])
        if error < (1.0 - LEAST_GAIN) * least:
            best, least = name, error
    return best


def _weighted(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray
) -> FloatArray:
    """(M·n, k + 11) columns of friction, load and target, in standard deviations."""
    wanted = (target - at.effort).ravel() + at.load @ parameters
    weight = np.tile(1.0 / sigma, len(target))[:, None]
    return np.column_stack([at.friction, at.load, wanted]) * weight


def _solved(R: FloatArray) -> Step:
    """Of the triangle of `_weighted`."""
    k = R.shape[1] - LOAD - 1
    factor, wanted = R[k : k + LOAD, k : k + LOAD], R[k : k + LOAD, -1]
    length = np.linalg.norm(factor, axis=0)
    if np.any(length == 0) or np.linalg.cond(factor / length) > 1e7:
        raise FitError(
            "the motion does not tell all ten parameters of a load",
            hint="record a motion in which every joint turns, the wrist's too",
        )
    found = nearest_body(factor, wanted)
    free = np.asarray(np.linalg.solve(factor, wanted))
    extra = np.asarray(np.linalg.solve(R[:k, :k], R[:k, -1] - R[:k, k : k + LOAD] @ found))
    return Step(found, extra, not is_body(free))


def _left_out(triangles: list[FloatArray], columns: list[int]) -> float:
    """Sum of squares of every triangle's rows by the solution to all others."""
    total = 0.0
    for fold, own in enumerate(triangles):
        others = np.vstack([R for number, R in enumerate(triangles) if number != fold])
        found = _solved(upper_triangle(others[:, columns]))
        whole = np.concatenate([found.extra, found.parameters, [-1.0]])
        total += float(np.sum((own[:, columns] @ whole) ** 2))
    return total


def _folds(offsets: IntArray) -> IntArray:
    """(M,) number of the stretch each row is in."""
    lengths = np.diff(offsets).tolist()
    return np.concatenate([np.arange(rows) * FOLDS // max(rows, 1) for rows in lengths])
