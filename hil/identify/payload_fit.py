"""The load of a loaded recording, by any fitted model of the arm without it.

A model predicts efforts from the motion and from each series' load (`payload_identified`). The load
is what makes that prediction fit: weighted least squares over its ten inertial parameters φ in the
flange frame, by Gauss–Newton, since friction may depend on the load. Every solution is a body that
positive masses can make.

Standard errors are those of the sandwich over blocks of time (see `hil.identify.clustered`): what
the model does not know about the arm repeats for a while and then changes. The load is the
difference to an arm that was itself identified, so its variance grows by the share of samples in
which that was done; this is right for alike motions and too little for a model of poorer ones.
"""

from __future__ import annotations

from typing import NamedTuple, get_args

import numpy as np

from hil.data.dataset import Dataset
from hil.dynamics import payload_parameters
from hil.errors import FitError, SpecError
from hil.identify.base import RobotEstimator
from hil.identify.blocks import time_blocks
from hil.identify.checks import require_clean, require_motion
from hil.identify.clustered import Clustered, ClusterSums, clustered_covariance, interval
from hil.identify.compress import upper_triangle
from hil.identify.load_body import central, central_jacobian, is_body, nearest_body, payload_of
from hil.identify.payload_estimate import Correction, PayloadEstimate
from hil.identify.payload_problem import Friction, Linearised, LoadProblem
from hil.payload import Payload
from hil.typing import BoolArray, FloatArray, IntArray

LOAD = 10
"""Inertial parameters of a load."""

MOST_STEPS = 16

FRESH = 5
"""Steps between Jacobians: they hardly change once the load is roughly known."""

SMALL_STEP = 1e-3
"""Settled when no prediction changes by more than this share of its joint's residual."""

LEVEL = 0.95


def estimate_payload(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    friction: Friction = "model",
    rows: BoolArray | None = None,
) -> PayloadEstimate:
    """The load under which a recording was made.

    Args:
        model: Fitted to recordings of the same arm whose loads are known. Its drive gains decide:
            gains that are 5 % too large make a load 5 % too heavy.
        dataset: Motion with one load, which need not be declared.
        friction: What of the model's friction may be another on that day: nothing (`model`), an
            offset per joint (`offset`), or an offset and a factor (`scale`).
        rows: (N,) rows to fit to, all by default. The model sees all of the motion.

    Raises:
        FitError: The recording does not tell: too few rows, no motion, or no load.
        DataError: It is of another robot or unit than the model.
        SpecError: There is no such way to treat friction.
    """
    if friction not in get_args(Friction):
        raise SpecError(
            f"friction is {friction!r}, but must be one of {', '.join(get_args(Friction))}"
        )
    require_clean(dataset, ("t", "q", "effort"))
    require_motion(dataset)
    problem = LoadProblem.of(model, dataset, friction, rows)
    return _told(problem, _settled(problem))


class _Solution(NamedTuple):
    """Where the steps ended.

    Attributes:
        parameters: (10,) of the load.
        extra: (k,) coefficients of the correction.
        at: The linearised prediction there.
        bounded: Whether least squares alone would leave what bodies can be.
    """

    parameters: FloatArray
    extra: FloatArray
    at: Linearised
    bounded: bool


def _settled(problem: LoadProblem) -> _Solution:
    at = Linearised(problem.bare.effort, problem.rigid, problem.columns(problem.bare))
    now = _step(problem, at, np.zeros(LOAD), np.maximum(problem.model.sigma_, 1e-9))
    for count in range(MOST_STEPS):
        here = problem.predict(now.parameters)
        fresh = count % FRESH == 0
        J = problem.jacobian(now.parameters, here) if fresh else now.at.load
        at = Linearised(here.effort, J, problem.columns(here))
        sigma = _rms(_residual(problem, at, now.extra))
        least = 1e-9 + 1e-9 * float(np.max(np.abs(problem.target)))
        before, now = now, _step(problem, at, now.parameters, np.maximum(sigma, least))
        change = (J @ (now.parameters - before.parameters)).reshape(here.effort.shape)
        if np.all(_rms(change) <= SMALL_STEP * np.maximum(sigma, least)):
            return now._replace(at=at._replace(effort=at.effort + change))
    raise FitError(
        "the load did not settle: the recording hardly tells it",
        hint="record a motion that turns the wrist as well as the arm",
    )


def _step(
    problem: LoadProblem, at: Linearised, parameters: FloatArray, sigma: FloatArray
) -> _Solution:
    """Load and correction that fit the linearised prediction best."""
    weight = np.tile(1.0 / sigma, len(problem.target))
    target = (problem.target - at.effort).ravel() + at.load @ parameters
    k = at.friction.shape[1]
    R = upper_triangle(np.column_stack([at.friction, at.load, target]) * weight[:, None])
    factor, wanted = R[k : k + LOAD, k : k + LOAD], R[k : k + LOAD, -1]
    _require_shown(factor)
    found = nearest_body(factor, wanted)
    free = np.asarray(np.linalg.solve(factor, wanted))
    extra = np.asarray(np.linalg.solve(R[:k, :k], R[:k, -1] - R[:k, k : k + LOAD] @ found))
    return _Solution(found, extra, at, not is_body(free))


def _require_shown(factor: FloatArray) -> None:
    length = np.linalg.norm(factor, axis=0)
    if np.any(length == 0) or np.linalg.cond(factor / np.where(length > 0, length, 1.0)) > 1e7:
        raise FitError(
            "the motion does not tell all ten parameters of a load",
            hint="record a motion in which every joint turns, the wrist's too",
        )


def _told(problem: LoadProblem, found: _Solution) -> PayloadEstimate:
    residual = _residual(problem, found.at, found.extra)
    blocks = time_blocks(residual, problem.kept.offsets)
    spread = _covariance(found.at, residual, blocks)
    # A load is a difference: the arm without it was measured with errors of the same kind.
    both = 1.0 + len(residual) / max(problem.model.samples_, 1)
    G = central_jacobian(found.parameters)
    error = np.sqrt(both * np.diag(G @ spread.covariance[:LOAD, :LOAD] @ G.T))
    values = _values(found.parameters)
    return PayloadEstimate(
        payload=payload_of(found.parameters),
        values=values,
        std_error=error,
        interval=interval(values, error, spread.degrees[:LOAD], LEVEL),
        residual=_rms(residual),
        without=_rms(problem.target - problem.bare.effort),
        unit=problem.data.effort_unit,
        joint_names=problem.data.joint_names,
        correction=_correction(found.extra, residual.shape[1]),
        samples=len(residual),
        blocks=len(np.unique(blocks)),
        bounded=found.bounded,
    )


def _covariance(at: Linearised, residual: FloatArray, blocks: IntArray) -> Clustered:
    """Of the load's parameters, then of the correction's coefficients."""
    X = np.hstack([at.load, at.friction])
    weight = np.tile(1.0 / np.maximum(_rms(residual), 1e-12) ** 2, len(residual))
    sums = ClusterSums.of(X, residual.ravel(), weight, np.repeat(blocks, residual.shape[1]))
    gram = sums.gram.sum(axis=0)
    # Parameters of a load differ by powers of ten; scaled, the inverse is safe.
    length = np.sqrt(np.diag(gram))
    scale = np.outer(length, length)
    return clustered_covariance(np.linalg.inv(gram / scale) / scale, sums, "CR2")


def _correction(extra: FloatArray, n: int) -> Correction:
    terms = extra.reshape(n, -1) if len(extra) else np.zeros((n, 1))
    return Correction(terms[:, 0], terms[:, 1] if terms.shape[1] > 1 else np.zeros(n))


def _residual(problem: LoadProblem, at: Linearised, extra: FloatArray) -> FloatArray:
    return problem.target - at.effort - (at.friction @ extra).reshape(at.effort.shape)


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _values(parameters: FloatArray) -> FloatArray:
    mass, com, inertia = central(parameters)
    return np.concatenate([[mass], com, inertia])


def true_values(payload: Payload) -> FloatArray:
    """(10,) of a known load, in the order of `PayloadEstimate.values`."""
    return _values(payload_parameters(payload))
