"""The load of a loaded recording, by any fitted model of the arm without it.

A model predicts efforts from the motion and from each series' load (`payload_identified`). The load
is what makes that prediction fit: weighted least squares over its ten inertial parameters φ in the
flange frame, by Gauss–Newton, since friction may depend on the load. Every solution is a body that
positive masses can make.

Standard errors are those of the sandwich over blocks of time (`hil.estimators.covariance`): what
the model does not know about the arm repeats for a while and then changes. The load is the
difference to an arm that was itself identified, so its variance grows by the share of samples in
which that was done; this is right for alike motions and too little for a model of poorer ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray, SpecError
from hil.data import Dataset
from hil.dynamics import payload_parameters
from hil.estimators.base import RobotEstimator
from hil.estimators.checks import require_clean, require_motion
from hil.estimators.covariance import (
    Clustered,
    ClusterSums,
    clustered_covariance,
    interval,
    time_blocks,
)
from hil.estimators.load_body import central, central_jacobian, payload_of
from hil.estimators.payload_estimate import Correction, PayloadEstimate
from hil.estimators.payload_problem import Friction, Linearised, LoadProblem
from hil.estimators.payload_step import LOAD, Step, best_friction, step

MOST_STEPS = 48
"""Weights follow the residuals; where wrong gains leave much of these, that settles slowly."""

FRESH = 5
"""Steps between Jacobians: they hardly change once the load is roughly known."""

SMALL_STEP = 1e-3
"""Settled when no prediction changes by more than this share of its joint's residual."""

LEVEL = 0.95


def estimate_payload(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    friction: Friction | Literal["auto"] = "auto",
    rows: BoolArray | None = None,
) -> PayloadEstimate:
    """The load under which a recording was made.

    Args:
        model: Fitted to recordings of the same arm whose loads are known. Its drive gains decide:
            gains that are 5 % too large make a load 5 % too heavy.
        dataset: Motion with one load, which need not be declared.
        friction: What of the model's friction may be another on that day: nothing (`model`), an
            offset per joint (`offset`), or an offset and a factor (`scale`); `auto` takes what
            errs least on stretches of the rows that are left out in turn.
        rows: (N,) rows to fit to, all by default. The model sees all of the motion.

    Raises:
        FitError: The recording does not tell: too few rows, no motion, or no load.
        DataError: It is of another robot or unit than the model, or of several loads.
        SpecError: There is no such way to treat friction.
    """
    require_friction(friction)
    require_one_load(dataset)
    require_clean(dataset, ("t", "q", "effort"))
    require_motion(dataset)
    if friction == "auto":
        return _told(*_chosen(LoadProblem.of(model, dataset, "scale", rows)))
    problem = LoadProblem.of(model, dataset, friction, rows)
    return _told(problem, _settled(problem))


def require_friction(friction: str) -> None:
    """Refuse what is no way to treat friction.

    Raises:
        SpecError: It is none.
    """
    known = ("auto", *get_args(Friction))
    if friction not in known:
        raise SpecError(f"friction is {friction!r}, but must be one of {', '.join(known)}")


def require_one_load(dataset: Dataset) -> None:
    """Refuse recordings made with several loads.

    Raises:
        DataError: They were.
    """
    loads = {(condition.load, condition.payload) for condition in dataset.conditions}
    if len(loads) > 1:
        masses = ", ".join(f"{load.mass:g}" for _, load in sorted(loads, key=lambda one: one[0]))
        raise DataError(
            f"the recordings were made with {len(loads)} loads ({masses} kg declared)",
            hint="give recordings of one load at a time; in Python, a part of the dataset",
        )


class _Solution(NamedTuple):
    """Where the steps ended, and the linearised prediction there."""

    step: Step
    at: Linearised


def _settled(problem: LoadProblem, start: FloatArray | None = None) -> _Solution:
    """Step by step from a load (10,), or from nothing."""
    least = 1e-9 + 1e-9 * float(np.max(np.abs(problem.target)))
    columns, J = problem.columns(problem.bare), problem.rigid
    if start is None:
        at = Linearised(problem.bare.effort, J, columns)
        sigma = np.maximum(problem.model.sigma_, least)
        now = step(at, np.zeros(LOAD), problem.target, sigma)
    else:
        now = Step(start, np.zeros(columns.shape[1]), False)
    for count in range(MOST_STEPS):
        here = problem.predict(now.parameters)
        if count % FRESH == 0:
            J = problem.jacobian(now.parameters, here)
        at = Linearised(here.effort, J, problem.columns(here))
        sigma = np.maximum(_rms(_residual(problem, at, now.extra)), least)
        before, now = now, step(at, now.parameters, problem.target, sigma)
        change = (J @ (now.parameters - before.parameters)).reshape(here.effort.shape)
        if np.all(_rms(change) <= SMALL_STEP * sigma) and count:
            return _Solution(now, at._replace(effort=at.effort + change))
    raise FitError(
        "the load did not settle: the recording hardly tells it",
        hint="record a motion that turns the wrist as well as the arm",
    )


def _chosen(problem: LoadProblem) -> tuple[LoadProblem, _Solution]:
    """The problem with what of the friction is best freed, and its solution."""
    widest = replace(problem, friction="scale")
    found = _settled(widest)
    sigma = np.maximum(_rms(_residual(widest, found.at, found.step.extra)), 1e-9)
    offsets, parameters = problem.kept.offsets, found.step.parameters
    best = best_friction(found.at, parameters, problem.target, sigma, offsets)
    if best == "scale":
        return widest, found
    narrower = replace(problem, friction=best)
    return narrower, _settled(narrower, parameters)


def _told(problem: LoadProblem, found: _Solution) -> PayloadEstimate:
    residual = _residual(problem, found.at, found.step.extra)
    blocks = time_blocks(residual, problem.kept.offsets)
    spread = _covariance(found.at, residual, blocks)
    # A load is a difference: the arm without it was measured with errors of the same kind.
    both = 1.0 + len(residual) / max(problem.model.samples_, 1)
    G = central_jacobian(found.step.parameters)
    covariance = both * G @ spread.covariance[:LOAD, :LOAD] @ G.T
    error = np.sqrt(np.diag(covariance))
    values = _values(found.step.parameters)
    return PayloadEstimate(
        payload=payload_of(found.step.parameters),
        values=values,
        std_error=error,
        interval=interval(values, error, spread.degrees[:LOAD], LEVEL),
        covariance=covariance,
        degrees=spread.degrees[:LOAD],
        by_gain=G @ _by_gain(found, residual),
        residual=_rms(residual),
        without=_rms(problem.target - problem.bare.effort),
        unit=problem.data.effort_unit,
        joint_names=problem.data.joint_names,
        friction=problem.friction,
        correction=_correction(found.step.extra, residual.shape[1]),
        samples=len(residual),
        blocks=len(np.unique(blocks)),
        bounded=found.step.bounded,
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


def _by_gain(found: _Solution, residual: FloatArray) -> FloatArray:
    """(10, n) by how much the parameters fall short per share that a joint's gain is larger.

    The true effort of the load is then less by that share, at that joint alone.
    """
    n = residual.shape[1]
    weight = 1.0 / np.maximum(_rms(residual), 1e-12)
    X = np.hstack([found.at.load, found.at.friction]) * np.tile(weight, len(residual))[:, None]
    length = np.linalg.norm(X, axis=0)
    carried = (found.at.load @ found.step.parameters).reshape(-1, n) * weight
    each = (carried[:, :, None] * np.eye(n)).reshape(-1, n)
    told = np.linalg.lstsq(X / length, each, rcond=None)[0] / length[:, None]
    return np.asarray(told[:LOAD])


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
