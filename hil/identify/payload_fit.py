"""The load of a loaded recording, by any fitted model of the arm without it.

A model predicts efforts from the motion and from each series' load (`payload_identified`). The load
is what makes that prediction fit: weighted least squares over its ten inertial parameters φ in the
flange frame, by Gauss–Newton. A rigid load alone is linear in φ, with the columns of
`RobotModel.payload_regressor`; what the model adds to that, such as friction that grows with the
torque, is not, and its part of the Jacobian comes from predictions with small point masses added,
which leave a load a load. Every solution is a body that positive masses can make.

Standard errors are those of the sandwich over blocks of time (see `hil.identify.clustered`): what
the model does not know about the arm repeats for a while and then changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from hil.data.dataset import Dataset, rows_of
from hil.data.filters import FilterSettings, is_prepared
from hil.data.prediction import Prediction
from hil.dynamics import joint_columns, payload_parameters
from hil.errors import FitError, SpecError
from hil.identify.base import RobotEstimator, prepared
from hil.identify.blocks import time_blocks
from hil.identify.checks import require_clean, require_motion
from hil.identify.clustered import ClusterSums, clustered_covariance, interval
from hil.identify.compress import upper_triangle
from hil.identify.load_body import (
    LENGTH_M,
    central,
    central_jacobian,
    is_body,
    nearest_body,
    payload_of,
    point_masses,
)
from hil.identify.payload_estimate import Correction, PayloadEstimate
from hil.payload import Payload
from hil.typing import BoolArray, FloatArray

Friction = Literal["model", "offset", "scale"]

LOAD = 10
"""Inertial parameters of a load."""

MOST_STEPS = 12
SMALL_STEP = 1e-3
"""Settled when no prediction changes by more than this share of its joint's residual."""

PROBE = 1e-3
"""Point masses of the differences, as a share of the load's mass."""

LEAST_ROWS = 200
LEVEL = 0.95


def with_identified(dataset: Dataset, payload: Payload) -> Dataset:
    """The same samples, with this load instead of the declared one."""
    conditions = tuple(replace(c, payload_identified=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)


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
    problem = _Problem.of(model, _filtered(model, dataset), friction, rows)
    return _estimate(problem, *_settled(problem))


def _filtered(model: RobotEstimator, dataset: Dataset) -> Dataset:
    if is_prepared(dataset):
        return dataset
    given = getattr(model, "filters", None)
    return prepared(dataset, given if isinstance(given, FilterSettings) else FilterSettings())


class _Linearised(NamedTuple):
    """A prediction and its derivatives at the rows that count.

    Attributes:
        effort: (M, n) predicted.
        load: (M·n, 10) derivative by the load's parameters.
        friction: (M·n, k) columns of the correction.
    """

    effort: FloatArray
    load: FloatArray
    friction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """What does not change from step to step.

    Attributes:
        model: The model of the arm.
        data: Filtered, every row.
        keep: (N,) rows that count.
        rigid: (M·n, 10) derivative of the effort by a rigid load alone.
        kept: The rows that count.
        friction: See `estimate_payload`.
    """

    model: RobotEstimator
    data: Dataset
    keep: BoolArray
    rigid: FloatArray
    kept: Dataset
    friction: Friction

    @staticmethod
    def of(
        model: RobotEstimator, data: Dataset, friction: Friction, rows: BoolArray | None
    ) -> _Problem:
        keep = np.ones(len(data), dtype=bool) if rows is None else np.asarray(rows, dtype=bool)
        keep = keep & np.all(model.predict(with_identified(data, Payload())).valid, axis=1)
        kept = rows_of(data, keep)
        if len(kept) < LEAST_ROWS:
            raise FitError(
                f"{len(kept)} rows are too few to tell a load: at least {LEAST_ROWS} are needed",
                hint="record the arm with the load on a motion of some seconds",
            )
        W = model.robot_.payload_regressor(*(kept[name] for name in ("q_f", "qd_f", "qdd_f")))
        scale = np.tile(model.torque_scale_, len(kept))
        return _Problem(model, data, keep, W / scale[:, None], kept, friction)

    @property
    def target(self) -> FloatArray:
        """(M, n) measured effort, filtered."""
        return self.kept["effort_f"]

    def predict(self, parameters: FloatArray | None) -> Prediction:
        """Of the rows that count, under a load; None for nothing."""
        load = Payload() if parameters is None else payload_of(parameters)
        return _only(self.model.predict(with_identified(self.data, load)), self.keep)

    def columns(self, prediction: Prediction) -> FloatArray:
        """(M·n, k) of the correction of friction."""
        terms = {"offset": np.ones_like(prediction.effort)}
        if self.friction == "scale" and "friction" in prediction.components:
            terms["scale"] = prediction.components["friction"]
        if self.friction == "model":
            return np.empty((prediction.effort.size, 0))
        return joint_columns(terms)

    def linearise(self, parameters: FloatArray) -> _Linearised:
        """At a load; the part that is not rigid by differences, if there is any."""
        here = self.predict(parameters)
        probes = point_masses(PROBE * float(parameters[0]), LENGTH_M)
        J = self.rigid
        all_at_once = parameters + probes.sum(axis=0)
        if np.max(np.abs(self._beyond_rigid(here, parameters, all_at_once))) > 1e-7 * PROBE:
            beyond = [self._beyond_rigid(here, parameters, parameters + probe) for probe in probes]
            # Row by row: beyond = probes · ∂/∂φ.
            J = J + np.linalg.solve(probes, np.array(beyond)).T
        return _Linearised(here.effort, J, self.columns(here))

    def _beyond_rigid(
        self, here: Prediction, parameters: FloatArray, other: FloatArray
    ) -> FloatArray:
        """(M·n,) by how much a prediction changes more than the torque of a rigid load."""
        change = self.predict(other).effort - here.effort
        left: FloatArray = change.ravel() - self.rigid @ (other - parameters)
        return left


class _Solution(NamedTuple):
    """Where the steps ended.

    Attributes:
        parameters: (10,) of the load.
        extra: (k,) coefficients of the correction.
        sigma: (n,) RMS of the residual.
        at: The linearised prediction there.
        bounded: Whether least squares alone would leave what bodies can be.
    """

    parameters: FloatArray
    extra: FloatArray
    sigma: FloatArray
    at: _Linearised
    bounded: bool


def _settled(problem: _Problem) -> tuple[_Solution, FloatArray]:
    """The solution and the (n,) RMS without any load."""
    bare = problem.predict(None)
    without = _rms(problem.target - bare.effort)
    start = _Linearised(bare.effort, problem.rigid, problem.columns(bare))
    sigma = np.maximum(problem.model.sigma_, 1e-9)
    parameters, extra, bounded = _step(problem, start, np.zeros(LOAD), sigma)
    for _ in range(MOST_STEPS):
        at = problem.linearise(parameters)
        error = _rms(_residual(problem, at, extra))
        sigma = np.maximum(error, 1e-9 + 1e-9 * float(np.max(np.abs(problem.target))))
        moved, extra, bounded = _step(problem, at, parameters, sigma)
        change = (at.load @ (moved - parameters)).reshape(problem.target.shape)
        parameters = moved
        if np.all(_rms(change) <= SMALL_STEP * sigma):
            break
    else:
        raise FitError(
            "the load did not settle: the recording hardly tells it",
            hint="record a motion that turns the wrist as well as the arm",
        )
    at = at._replace(effort=at.effort + change)
    return _Solution(parameters, extra, _rms(_residual(problem, at, extra)), at, bounded), without


def _step(
    problem: _Problem, at: _Linearised, parameters: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """Load and correction that fit the linearised prediction best; whether a bound held them."""
    weight = np.tile(1.0 / sigma, len(problem.target))
    target = (problem.target - at.effort).ravel() + at.load @ parameters
    k = at.friction.shape[1]
    stacked = np.column_stack([at.friction, at.load, target]) * weight[:, None]
    R = upper_triangle(stacked)
    lower = R[k : k + LOAD, k : k + LOAD]
    wanted = R[k : k + LOAD, -1]
    _require_told(lower)
    found = nearest_body(lower, wanted)
    free = np.asarray(np.linalg.solve(lower, wanted))
    extra = np.asarray(np.linalg.solve(R[:k, :k], R[:k, -1] - R[:k, k : k + LOAD] @ found))
    return found, extra, not is_body(free)


def _require_told(factor: FloatArray) -> None:
    length = np.linalg.norm(factor, axis=0)
    if np.any(length == 0) or np.linalg.cond(factor / np.where(length > 0, length, 1.0)) > 1e7:
        raise FitError(
            "the motion does not tell all ten parameters of a load",
            hint="record a motion in which every joint turns, the wrist's too",
        )


def _estimate(problem: _Problem, found: _Solution, without: FloatArray) -> PayloadEstimate:
    n, k = len(without), len(found.extra)
    residual = _residual(problem, found.at, found.extra)
    X = np.hstack([found.at.load, found.at.friction])
    weight = np.tile(1.0 / found.sigma**2, len(residual))
    blocks = time_blocks(residual, problem.kept.offsets)
    sums = ClusterSums.of(X, residual.ravel(), weight, np.repeat(blocks, n))
    # Parameters of a load differ by powers of ten; scaled, the inverse is safe.
    length = np.sqrt(np.einsum("ij,i,ij->j", X, weight, X))
    gram = (X * weight[:, None]).T @ X / np.outer(length, length)
    bread = np.linalg.inv(gram) / np.outer(length, length)
    told = clustered_covariance(bread, sums, "CR1")
    G = central_jacobian(found.parameters)
    error = np.sqrt(np.diag(G @ told.covariance[:LOAD, :LOAD] @ G.T))
    mass, com, inertia = central(found.parameters)
    values = np.concatenate([[mass], com, inertia])
    offset = found.extra.reshape(n, -1)[:, 0] if k else np.zeros(n)
    scale = found.extra.reshape(n, -1)[:, 1] if k == 2 * n else np.zeros(n)
    return PayloadEstimate(
        payload=payload_of(found.parameters),
        values=values,
        std_error=error,
        interval=interval(values, error, told.degrees[:LOAD], LEVEL),
        residual=found.sigma,
        without=without,
        unit=problem.data.effort_unit,
        joint_names=problem.data.joint_names,
        correction=Correction(offset, scale),
        samples=len(residual),
        blocks=len(sums.score),
        bounded=found.bounded,
    )


def _residual(problem: _Problem, at: _Linearised, extra: FloatArray) -> FloatArray:
    return problem.target - at.effort - (at.friction @ extra).reshape(at.effort.shape)


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _only(prediction: Prediction, keep: BoolArray) -> Prediction:
    return Prediction(
        prediction.effort[keep],
        prediction.std[keep],
        prediction.valid[keep],
        {name: part[keep] for name, part in prediction.components.items()},
    )


def true_values(payload: Payload) -> FloatArray:
    """(10,) of a known load, in the order of `PayloadEstimate.values`."""
    mass, com, inertia = central(payload_parameters(payload))
    return np.concatenate([[mass], com, inertia])
