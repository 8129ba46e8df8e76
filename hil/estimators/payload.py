"""Payload identification from a motion, with any fitted model of the arm without the payload.

A model predicts efforts from the motion and from the payload of each series (`payload_identified`).
`estimate_payload` determines the payload for which this prediction fits the measured effort. The
payload is computed by weighted least squares over the ten inertial parameters φ in the flange
frame. The payload identification uses Gauss–Newton iterations, because the friction may depend on
the payload.

The effort of a rigid payload is linear in φ, with the columns of `RobotModel.payload_regressor`. If
a model contains other effects of the payload, such as friction that grows with the torque, these
effects are differentiated numerically. The numerical differences use small point masses added to
the payload, because a payload with an added point mass is still a physically consistent body. The
weights of the joints follow from the residuals of the joints. `best_friction` chooses by
cross-validation over stretches of time how much of the friction model is re-estimated.

Every solution is physically consistent (`nearest_body`): its 4 × 4 pseudo-inertia [[Σ, h], [hᵀ, m]]
is positive semi-definite, with Σ = ½·tr(I)·1 − I (Wensing, Kim & Slotine, IEEE RA-L 2018).

Standard errors come from the sandwich estimator over blocks of time (`hil.estimators.covariance`),
because errors of the arm model persist for a while and then change. The identified payload is the
difference to an arm that was itself identified from data. The variance of the payload parameters is
therefore multiplied by 1 plus the ratio of the samples of this fit to the samples of the arm model.
The factor is right if the arm model and the payload were fitted to similar motions, and too small
if the arm model was fitted to poorer motions. `payload_halves` fits the payload to one half of a
recording and tests it on the other half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray, SpecError, card, number
from hil.data import MOTION, Dataset, FilterSettings, Prediction, is_prepared, rows_of, sample_rate
from hil.dynamics import (
    body_parameters,
    from_pseudo_inertia,
    joint_columns,
    payload_parameters,
    pseudo_inertia,
    skew,
)
from hil.estimators.base import RobotEstimator, prepared
from hil.estimators.checks import require_clean, require_motion
from hil.estimators.covariance import (
    Clustered,
    ClusterSums,
    clustered_covariance,
    interval,
    time_blocks,
)
from hil.estimators.least_squares import upper_triangle

Friction = Literal["model", "offset", "scale"]


def estimate_payload(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    friction: Friction | Literal["auto"] = "auto",
    rows: BoolArray | None = None,
) -> PayloadEstimate:
    """Return the payload that was mounted during a recording.

    Args:
        model: Model fitted to recordings of the same arm with known payloads. Errors of the drive
            gains of the model scale the identified payload: gains that are 5 % too large make a
            payload 5 % too heavy.
        dataset: Motion with one payload, which need not be declared.
        friction: Friction parameters to re-estimate: no parameter (`model`), an offset per joint
            (`offset`), or an offset and a factor per joint (`scale`). The value `auto` chooses the
            treatment with the smallest cross-validation error over stretches of the rows.
        rows: (N,) mask of the rows used in the fit; all rows if None. The effort of the whole
            motion is predicted, regardless of `rows`.

    Raises:
        FitError: The recording does not determine a payload, because there are too few rows, no
            motion, or no payload.
        DataError: Robot or unit of the recording differ from those of the model, or the recording
            contains several payloads.
        SpecError: The name of the friction treatment is unknown.
    """
    require_friction(friction)
    require_one_load(dataset)
    require_clean(dataset, ("t", "q", "effort"))
    require_motion(dataset)
    if friction == "auto":
        return _estimate(*_chosen(LoadProblem.of(model, dataset, "scale", rows)))
    problem = LoadProblem.of(model, dataset, friction, rows)
    return _estimate(problem, _settled(problem))


def require_friction(friction: str) -> None:
    """Raise if the friction treatment is unknown.

    Raises:
        SpecError: The friction treatment is neither `auto` nor a value of `Friction`.
    """
    known = ("auto", *get_args(Friction))
    if friction not in known:
        raise SpecError(f"friction is {friction!r}, but must be one of {', '.join(known)}")


def require_one_load(dataset: Dataset) -> None:
    """Raise if the recordings were made with several payloads.

    Raises:
        DataError: The series declare more than one payload.
    """
    loads = {(condition.load, condition.payload) for condition in dataset.conditions}
    if len(loads) > 1:
        masses = ", ".join(f"{load.mass:g}" for _, load in sorted(loads, key=lambda one: one[0]))
        raise DataError(
            f"the recordings declare {len(loads)} different payloads ({masses} kg)",
            hint="pass only recordings with the same payload; in Python, a part of the dataset",
        )


def _chosen(widest: LoadProblem) -> tuple[LoadProblem, Solution]:
    """Return the identification problem with the best friction treatment, and its solution.

    Args:
        widest: Problem in which all friction corrections are free.
    """
    found = _settled(widest)
    sigma = np.maximum(rms(_residual(widest, found.at, found.step.extra)), 1e-9)
    offsets, parameters = widest.kept.offsets, found.step.parameters
    best = best_friction(found.at, parameters, widest.target, sigma, offsets)
    if best == "scale":
        return widest, found
    narrower = replace(widest, friction=best)
    return narrower, _settled(narrower, parameters)


MOST_STEPS = 48
"""Maximum number of Gauss–Newton steps.

The weights of the joints follow from the residuals; this iteration converges slowly if wrong drive
gains dominate the residuals.
"""

FRESH = 5
"""Number of steps between evaluations of the Jacobian, which hardly changes near the end."""

SMALL_STEP = 1e-3
"""Convergence limit: largest RMS change of a joint's prediction, as a share of its residual."""


class Solution(NamedTuple):
    """Last step of the iteration, with the prediction linearised at this step."""

    step: Step
    at: Linearised


def _settled(problem: LoadProblem, start: FloatArray | None = None) -> Solution:
    """Return the converged solution, starting from a payload (10,) or from no payload."""
    least = 1e-9 + 1e-9 * float(np.max(np.abs(problem.target)))
    columns, J = problem.columns(problem.bare), problem.rigid
    if start is None:
        at = Linearised(problem.bare.effort, J, columns)
        sigma = np.maximum(problem.model.sigma_, least)
        now = best_load(at, np.zeros(LOAD), problem.target, sigma)
    else:
        now = Step(start, np.zeros(columns.shape[1]), False)
    for count in range(MOST_STEPS):
        here = problem.predict(now.parameters)
        if count % FRESH == 0:
            J = problem.jacobian(now.parameters, here)
        at = Linearised(here.effort, J, problem.columns(here))
        sigma = np.maximum(rms(_residual(problem, at, now.extra)), least)
        before, now = now, best_load(at, now.parameters, problem.target, sigma)
        change = (J @ (now.parameters - before.parameters)).reshape(here.effort.shape)
        if np.all(rms(change) <= SMALL_STEP * sigma) and count:
            return Solution(now, at._replace(effort=at.effort + change))
    raise FitError(
        "the payload estimate did not converge: the recording hardly determines the payload",
        hint="record a motion that turns the wrist as well as the arm",
    )


def _residual(problem: LoadProblem, at: Linearised, extra: FloatArray) -> FloatArray:
    return problem.target - at.effort - (at.friction @ extra).reshape(at.effort.shape)


def rms(values: FloatArray) -> FloatArray:
    """Return (n,) the root mean square of each column of values (N, n)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _estimate(problem: LoadProblem, found: Solution) -> PayloadEstimate:
    residual = _residual(problem, found.at, found.step.extra)
    blocks = time_blocks(residual, problem.kept.offsets)
    spread = _covariance(found.at, residual, blocks)
    # The payload is a difference to the arm model, which has errors of the same kind.
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
        residual=rms(residual),
        without=rms(problem.target - problem.bare.effort),
        unit=problem.data.effort_unit,
        joint_names=problem.data.joint_names,
        friction=problem.friction,
        correction=_correction(found.step.extra, residual.shape[1]),
        samples=len(residual),
        blocks=len(np.unique(blocks)),
        bounded=found.step.bounded,
    )


def _covariance(at: Linearised, residual: FloatArray, blocks: IntArray) -> Clustered:
    """Return the covariance of the payload parameters, followed by the correction coefficients."""
    X = np.hstack([at.load, at.friction])
    weight = np.tile(1.0 / np.maximum(rms(residual), 1e-12) ** 2, len(residual))
    sums = ClusterSums.of(X, residual.ravel(), weight, np.repeat(blocks, residual.shape[1]))
    gram = sums.gram.sum(axis=0)
    # Payload parameters differ by powers of ten, so the matrix is scaled before the inversion.
    length = np.sqrt(np.diag(gram))
    scale = np.outer(length, length)
    return clustered_covariance(np.linalg.inv(gram / scale) / scale, sums, "CR2")


def _by_gain(found: Solution, residual: FloatArray) -> FloatArray:
    """Return (10, n) the sensitivity of each payload parameter to the drive gain of each joint.

    If the true gain of a joint exceeds the gain in the model by a share s, the estimated parameter
    is too small by s times this sensitivity.
    """
    n = residual.shape[1]
    weight = 1.0 / np.maximum(rms(residual), 1e-12)
    X = np.hstack([found.at.load, found.at.friction]) * np.tile(weight, len(residual))[:, None]
    length = np.linalg.norm(X, axis=0)
    carried = (found.at.load @ found.step.parameters).reshape(-1, n) * weight
    each = (carried[:, :, None] * np.eye(n)).reshape(-1, n)
    told = np.linalg.lstsq(X / length, each, rcond=None)[0] / length[:, None]
    return np.asarray(told[:LOAD])


def _correction(extra: FloatArray, n: int) -> Correction:
    terms = extra.reshape(n, -1) if len(extra) else np.zeros((n, 1))
    return Correction(terms[:, 0], terms[:, 1] if terms.shape[1] > 1 else np.zeros(n))


def _values(parameters: FloatArray) -> FloatArray:
    mass, com, inertia = central(parameters)
    return np.concatenate([[mass], com, inertia])


def true_values(payload: Payload) -> FloatArray:
    """Return (10,) the parameters of a known payload, in the order of `PayloadEstimate.values`."""
    return _values(payload_parameters(payload))


GAP_S = 0.5
"""Time from the cut between two halves within which rows are not fitted [s].

The effort filter mixes samples of both halves within this time.
"""


@dataclass(frozen=True, slots=True, eq=False)
class HalfTested:
    """Payload identified from one half of a recording, with its errors on the other half.

    Attributes:
        fitted: Half to which the payload was fitted: `first` or `second`.
        estimate: Identified payload.
        rmse_raw: (n,) RMS error of the unfiltered effort, predicted with the payload.
        rmse_ignored: (n,) RMS error of the unfiltered effort, predicted without any payload.
    """

    fitted: str
    estimate: PayloadEstimate
    rmse_raw: FloatArray
    rmse_ignored: FloatArray

    @property
    def mean_raw(self) -> float:
        """Mean of `rmse_raw` over the joints."""
        return float(np.mean(self.rmse_raw))


def payload_halves(
    model: RobotEstimator, dataset: Dataset, *, friction: Friction | Literal["auto"] = "auto"
) -> tuple[HalfTested, HalfTested]:
    """Fit the payload to each half of every series, and test it on the other half.

    The effort of the whole series is predicted, because the friction memory of a model needs the
    history. The fit uses neither the effort of the tested half nor the effort near the cut.

    Args:
        model: Model that was fitted to other recordings than this recording.
        dataset: Unfiltered recording with a payload.
        friction: Friction treatment, as in `estimate_payload`.
    """
    first, near = halves(dataset)
    return (
        _tested("first", model, dataset, first & ~near, ~first, friction),
        _tested("second", model, dataset, ~first & ~near, first, friction),
    )


def halves(dataset: Dataset) -> tuple[BoolArray, BoolArray]:
    """Return two masks (N,): rows in the first half of their series, and rows near the cut."""
    first, near = np.zeros(len(dataset), dtype=bool), np.zeros(len(dataset), dtype=bool)
    for _, rows in dataset.slices():
        middle = (rows.start + rows.stop) // 2
        first[rows.start : middle] = True
        gap = int(np.ceil(GAP_S * sample_rate(dataset["t"][rows])))
        near[max(rows.start, middle - gap) : min(rows.stop, middle + gap)] = True
    return first, near


def _tested(
    fitted: str,
    model: RobotEstimator,
    dataset: Dataset,
    train: BoolArray,
    test: BoolArray,
    friction: Friction | Literal["auto"],
) -> HalfTested:
    estimate = estimate_payload(model, dataset, friction=friction, rows=train)
    bare = model.predict(with_identified(dataset, Payload()))
    loaded = model.predict(with_identified(dataset, estimate.payload))
    effort = loaded.effort + estimate.correction.of(loaded)
    rows = test & np.all(loaded.valid, axis=1)
    measured = dataset["effort"][rows]
    error, ignored = measured - effort[rows], measured - bare.effort[rows]
    return HalfTested(fitted, estimate, *(np.sqrt(np.mean(e**2, axis=0)) for e in (error, ignored)))


NAMES = ("mass", "com_x", "com_y", "com_z", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")

UNITS = ("kg", *3 * ("m",), *6 * ("kg·m²",))

LEVEL = 0.95

MASS_SHARE = 0.05
"""Maximum half width of the 95 % interval of a well-determined mass, as a share of the mass."""

COM_REACH_M = 0.01
"""Maximum half width of the interval of a well-determined centre-of-mass coordinate [m]."""

INERTIA_SHARE = 0.25
"""Maximum half width of a well-determined inertia's interval, as a share of the largest one."""


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Difference between the friction in a recording and the friction in the arm model.

    Attributes:
        offset: (n,) constant to be added to the prediction [A or N·m].
        scale: (n,) share of the friction in the model that is to be added to the prediction.
    """

    offset: FloatArray
    scale: FloatArray

    def of(self, prediction: Prediction) -> FloatArray:
        """Return (N, n) the correction to be added to a prediction."""
        zero = np.zeros_like(prediction.effort)
        friction = prediction.components.get("friction", zero) if np.any(self.scale) else zero
        added: FloatArray = self.offset + self.scale * friction
        return added


@dataclass(frozen=True, slots=True, eq=False)
class PayloadEstimate:
    """Payload identified from a motion or from static poses.

    The identified values are in the order of `NAMES`: mass, centre of mass in the flange frame,
    inertia about the centre of mass in flange axes.

    Attributes:
        payload: Identified payload, always physically consistent. For static poses, the payload is
            a point mass whose unobservable coordinates are 0, or an empty payload if no mass is
            detected.
        values: (10,) identified parameters; NaN for parameters that static poses do not determine.
        std_error: (10,) standard errors which assume that the form of the model and its drive gains
            are right. For static poses, the standard errors include the errors of the model and of
            the drive gains.
        interval: (10, 2) limits of the 95 % confidence intervals from Student's t distribution over
            blocks of time.
        covariance: (10, 10) covariance of the values; its diagonal contains the squares of
            `std_error`.
        degrees: (10,) degrees of freedom of Student's t distribution for each value.
        by_gain: (10, n) sensitivity of each value to each drive gain. If the true drive gain of a
            joint exceeds the gain in the model by a share s, a value is too small by s times its
            sensitivity. The sensitivity is valid if the torques of the arm were fitted with the
            same drive gain. `std_error` does not include drive-gain errors.
        residual: (n,) RMS of the filtered effort minus the prediction that includes the payload.
        without: (n,) RMS of the filtered effort minus the prediction that excludes the payload.
        unit: Unit of the residuals, `A` or `N·m`.
        joint_names: Names of the n joints.
        friction: Friction correction that was estimated: `model` (no correction), `offset` or
            `scale`. The value `rest` denotes static poses, at which the mean of two approach
            directions cancels the friction.
        correction: Friction correction that was estimated; zeros if the friction was not corrected.
        samples: Number of rows that the fit used; for static poses, the number of poses.
        blocks: Number of independent blocks of time; for static poses, the number of poses.
        bounded: Whether the unconstrained solution would be physically inconsistent. The standard
            errors ignore the constraint of physical consistency.
        gain_share: Standard deviation of a drive gain that is included in the standard errors, as a
            share of the gain.
        other_arm: Warning that the recording is of a different individual robot than the model. The
            text `other_arm` is empty if there is no reason for this warning.
        notes: List of notes for the user.
    """

    payload: Payload
    values: FloatArray
    std_error: FloatArray
    interval: FloatArray
    covariance: FloatArray
    degrees: FloatArray
    by_gain: FloatArray
    residual: FloatArray
    without: FloatArray
    unit: str
    joint_names: tuple[str, ...]
    friction: str
    correction: Correction
    samples: int
    blocks: int
    bounded: bool
    notes: tuple[str, ...] = ()
    gain_share: float = 0.0
    other_arm: str = ""

    def __repr__(self) -> str:
        low, high = self.interval[0]
        return f"<PayloadEstimate {self.values[0]:.3g} kg ({low:.3g} … {high:.3g})>"

    def _repr_html_(self) -> str:
        """Return the payload as an HTML table for a notebook, one row per determined parameter."""
        rows = [
            (one["name"], number(one["value"]), number(one["std_error"]),
             " … ".join(map(number, one["interval_95"])), "yes" if one["determined"] else "no")
            for one in self.to_dict()["parameters"]
            if one["value"] is not None
        ]  # fmt: skip
        head = ("parameter", "value", "± std", "95 % interval", "well determined")
        warned = [f"Unreliable: {self.other_arm}"] if self.other_arm else []
        facts = {"samples": self.samples, "independent": self.blocks, "friction": self.friction}
        notes = [*warned, *self.notes]
        return card("Load", f"{self.values[0]:.3g} kg", facts, table=(head, rows), notes=notes)

    def with_gains(self, share: float) -> PayloadEstimate:
        """Return the payload estimate with standard errors that include drive-gain errors.

        The drive-gain errors are assumed to be independent between joints.

        Args:
            share: Standard deviation of a drive gain, as a share of the gain. Because torque data
                have no drive gains, `share` is not used for torques.
        """
        gains = share if self.unit == "A" else 0.0
        covariance = self.covariance + gains**2 * self.by_gain @ self.by_gain.T
        error = np.sqrt(np.diag(covariance))
        ends = interval(self.values, error, self.degrees, LEVEL)
        return replace(
            self, covariance=covariance, std_error=error, interval=ends, gain_share=gains
        )

    @property
    def determined(self) -> dict[str, bool]:
        """Whether the recording determines each of the ten values well, by value name."""
        reach = (self.interval[:, 1] - self.interval[:, 0]) / 2
        largest = float(np.max(np.abs(self.values[4:7]), initial=0.0))
        limit = np.array(
            [MASS_SHARE * self.values[0], *3 * [COM_REACH_M], *6 * [INERTIA_SHARE * largest]]
        )
        return dict(zip(NAMES, (reach <= limit).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Return the payload estimate in the format of `hil payload --json`."""
        rows = zip(NAMES, UNITS, self.values, self.std_error, self.interval, strict=True)
        known = self.determined
        return {
            "payload": {
                "mass_kg": self.payload.mass,
                "com_m": _numbers(self.values[1:4]),
                "inertia_kgm2": _numbers(self.values[4:]),
            },
            "parameters": [
                {
                    "name": name, "unit": unit, "value": _number(value),
                    "std_error": _number(error), "interval_95": _numbers(ends),
                    "determined": known[name],
                }
                for name, unit, value, error, ends in rows
            ],
            "joint_names": list(self.joint_names),
            "unit": self.unit,
            "residual": [float(value) for value in self.residual],
            "residual_without_load": [float(value) for value in self.without],
            "friction": self.friction,
            "correction": {
                "offset": [float(value) for value in self.correction.offset],
                "scale": [float(value) for value in self.correction.scale],
            },
            "samples": self.samples,
            "blocks": self.blocks,
            "bounded": self.bounded,
            "gain_share": self.gain_share,
            "other_arm": self.other_arm,
            "notes": list(self.notes),
        }  # fmt: skip


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(value) for value in values]


def _number(value: float) -> float | None:
    """Return a finite value as a float, and None otherwise, because JSON has no NaN."""
    return float(value) if np.isfinite(value) else None


PROBE = 1e-3
"""Mass of the point masses for numerical differences, as a share of the payload mass."""

ROUNDING = 1e-9
"""Effort difference up to which the model treats a payload as purely rigid.

The effort limit applies to the difference between the predicted effort and the rigid effort of all
point masses together.
"""

LEAST_ROWS = 200


def with_identified(dataset: Dataset, payload: Payload) -> Dataset:
    """Return the same samples with a payload as the identified payload of every series."""
    conditions = tuple(replace(c, payload_identified=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)


class Linearised(NamedTuple):
    """Predicted effort and its derivatives at the rows used in the fit.

    Attributes:
        effort: (M, n) predicted effort.
        load: (M·n, 10) derivatives of the effort with respect to the payload parameters.
        friction: (M·n, k) columns of the friction correction.
    """

    effort: FloatArray
    load: FloatArray
    friction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoadProblem:
    """Data of a payload identification that stay constant during the iterations.

    Attributes:
        model: Model of the arm.
        data: Filtered dataset with all N rows.
        keep: (N,) mask of the M rows used in the fit.
        kept: Filtered dataset with the M rows used in the fit.
        bare: Predicted effort of these M rows without payload.
        rigid: (M·n, 10) derivatives of the effort with respect to the parameters of a rigid
            payload.
        friction: Friction treatment, as in `hil.estimators.payload.estimate_payload`.
    """

    model: RobotEstimator
    data: Dataset
    keep: BoolArray
    kept: Dataset
    bare: Prediction
    rigid: FloatArray
    friction: Friction

    @staticmethod
    def of(
        model: RobotEstimator, dataset: Dataset, friction: Friction, rows: BoolArray | None
    ) -> LoadProblem:
        """Return the problem of a recording, filtered like the training data of the model.

        Args:
            model: Fitted model of the arm.
            dataset: Recording of a motion with the payload.
            friction: Friction treatment, as in `hil.estimators.payload.estimate_payload`.
            rows: (N,) mask of the rows to use; all rows if None. Rows without a valid prediction
                are never used.

        Raises:
            FitError: Fewer than `LEAST_ROWS` rows can be used.
            DataError: Robot or unit of the recording differ from those of the model.
        """
        data = _filtered(model, dataset)
        bare = model.predict(with_identified(data, Payload()))
        keep = np.all(bare.valid, axis=1)
        if rows is not None:
            keep = keep & np.asarray(rows, dtype=bool)
        kept = rows_of(data, keep)
        if len(kept) < LEAST_ROWS:
            raise FitError(
                f"{len(kept)} rows are too few to identify a payload: at least {LEAST_ROWS} are "
                "needed",
                hint="record a motion of several seconds with the payload mounted",
            )
        W = model.robot_.payload_regressor(*(kept[name] for name in MOTION))
        rigid = W / np.tile(model.torque_scale_, len(kept))[:, None]
        return LoadProblem(model, data, keep, kept, _only(bare, keep), rigid, friction)

    @property
    def target(self) -> FloatArray:
        """Measured and filtered effort (M, n) of the rows used in the fit."""
        return self.kept["effort_f"]

    def predict(self, parameters: FloatArray) -> Prediction:
        """Return the predicted effort of the rows used in the fit, for payload parameters (10,)."""
        load = payload_of(parameters)
        return _only(self.model.predict(with_identified(self.data, load)), self.keep)

    def columns(self, prediction: Prediction) -> FloatArray:
        """Return (M·n, k) the regressor columns of the friction correction."""
        terms = {"offset": np.ones_like(prediction.effort)}
        if self.friction == "scale" and "friction" in prediction.components:
            terms["scale"] = prediction.components["friction"]
        if self.friction == "model":
            return np.empty((prediction.effort.size, 0))
        return joint_columns(terms)

    def jacobian(self, parameters: FloatArray, here: Prediction) -> FloatArray:
        """Return (M·n, 10) the derivatives of the effort with respect to the payload parameters.

        The derivatives of the effort include effects of the model beyond a rigid payload, such as
        payload-dependent friction. The computation of the derivatives takes eleven predictions if
        the model has payload effects beyond a rigid payload, and one prediction if not.
        """
        probes = point_masses(PROBE * float(parameters[0]), LENGTH_M)
        together = self._beyond_rigid(here, parameters, probes.sum(axis=0))
        if np.max(np.abs(together)) <= ROUNDING:
            return self.rigid
        beyond = np.array([self._beyond_rigid(here, parameters, probe) for probe in probes])
        # Row by row: beyond = probes · ∂/∂φ.
        return self.rigid + np.linalg.solve(probes, beyond).T

    def _beyond_rigid(
        self, here: Prediction, parameters: FloatArray, added: FloatArray
    ) -> FloatArray:
        """Return (M·n,) the effort change beyond the effort of a rigid added payload."""
        change = self.predict(parameters + added).effort - here.effort
        left: FloatArray = change.ravel() - self.rigid @ added
        return left


def _filtered(model: RobotEstimator, dataset: Dataset) -> Dataset:
    if is_prepared(dataset):
        return dataset
    given = getattr(model, "filters_", None) or getattr(model, "filters", None)
    return prepared(dataset, given if isinstance(given, FilterSettings) else FilterSettings())


def _only(prediction: Prediction, keep: BoolArray) -> Prediction:
    return Prediction(
        prediction.effort[keep],
        prediction.std[keep],
        prediction.valid[keep],
        {name: part[keep] for name, part in prediction.components.items()},
    )


LOAD = 10
"""Number of inertial parameters of a payload."""


class Step(NamedTuple):
    """Result of one Gauss–Newton step of the payload fit.

    Attributes:
        parameters: (10,) payload parameters.
        extra: (k,) coefficients of the friction correction.
        bounded: Whether the unconstrained least-squares solution is physically inconsistent.
    """

    parameters: FloatArray
    extra: FloatArray
    bounded: bool


def best_load(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray
) -> Step:
    """Return the payload and friction correction that fit best to a linearised prediction.

    Args:
        at: Prediction that was linearised at `parameters`.
        parameters: (10,) payload parameters at which the prediction was linearised.
        target: (M, n) measured effort.
        sigma: (n,) standard deviations with which the joints are weighted.

    Raises:
        FitError: The motion does not determine all ten parameters.
    """
    return _solved(upper_triangle(_weighted(at, parameters, target, sigma)))


def _solved(R: FloatArray) -> Step:
    """Return the Gauss–Newton step for the triangular factor of the output of `_weighted`."""
    k = R.shape[1] - LOAD - 1
    factor, wanted = R[k : k + LOAD, k : k + LOAD], R[k : k + LOAD, -1]
    length = np.linalg.norm(factor, axis=0)
    if np.any(length == 0) or np.linalg.cond(factor / length) > 1e7:
        raise FitError(
            "the motion does not determine all ten parameters of a payload",
            hint="record a motion in which every joint turns, including the wrist joints",
        )
    found = nearest_body(factor, wanted)
    free = np.asarray(np.linalg.solve(factor, wanted))
    extra = np.asarray(np.linalg.solve(R[:k, :k], R[:k, -1] - R[:k, k : k + LOAD] @ found))
    return Step(found, extra, not is_body(free))


def _weighted(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Return (M·n, k + 11) the weighted columns of friction correction, payload and target.

    Each row is divided by the standard deviation of its joint.
    """
    wanted = (target - at.effort).ravel() + at.load @ parameters
    weight = np.tile(1.0 / sigma, len(target))[:, None]
    return np.column_stack([at.friction, at.load, wanted]) * weight


FOLDS = 5
"""Number of time stretches per series in the cross-validation of the friction treatment."""

LEAST_GAIN = 0.01
"""Minimum reduction of the squared cross-validation error that justifies more free parameters.

The minimum reduction is a share of the squared error.
"""


def best_friction(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray, offsets: IntArray
) -> Friction:
    """Return the friction treatment with the smallest cross-validation error over time.

    Each of the `FOLDS` stretches of every series is predicted from all other stretches.

    Args:
        at: Linearised prediction with the columns of all friction corrections.
        parameters: (10,) payload parameters at which the prediction was linearised.
        target: (M, n) measured effort.
        sigma: (n,) standard deviations with which the joints are weighted.
        offsets: (S + 1,) row at which each series begins.
    """
    n = target.shape[1]
    rows = _weighted(at, parameters, target, sigma)
    number = np.repeat(_stretches(offsets), n)
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


def _left_out(triangles: list[FloatArray], columns: list[int]) -> float:
    """Return the sum of squared errors of every stretch, predicted from all other stretches."""
    total = 0.0
    for fold, own in enumerate(triangles):
        others = np.vstack([R for number, R in enumerate(triangles) if number != fold])
        found = _solved(upper_triangle(others[:, columns]))
        whole = np.concatenate([found.extra, found.parameters, [-1.0]])
        total += float(np.sum((own[:, columns] @ whole) ** 2))
    return total


def _stretches(offsets: IntArray) -> IntArray:
    """Return (M,) the index of the stretch to which each row belongs."""
    lengths = np.diff(offsets).tolist()
    return np.concatenate([np.arange(rows) * FOLDS // max(rows, 1) for rows in lengths])


LENGTH_M = 0.1
"""Length unit that scales the payload parameters to similar magnitudes [m]."""

THINNEST_KGM2 = 1e-7
"""Minimum second moment of mass of a fitted payload in every direction [kg·m²].

The minimum excludes a point mass, which rounding could make physically inconsistent.
"""

LIGHTEST_KG = 1e-4
"""Minimum mass of a fitted payload [kg]; without mass, the centre of mass is undefined."""

SMALLEST_GAP = 1e-6
"""Maximum excess of the sum of squares over its minimum, as a share of the sum of squares."""

MOST_NEWTON = 30


def payload_of(parameters: FloatArray) -> Payload:
    """Return the payload with these parameters (10,); the mass must be above 0."""
    m, c, I = central(parameters)  # noqa: E741
    x, y, z = (float(value) for value in c)
    xx, yy, zz, xy, xz, yz = (float(value) for value in I)
    return Payload(float(m), (x, y, z), (xx, yy, zz, xy, xz, yz))


def central(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass (3,), and inertia (6,): Ixx Iyy Izz Ixy Ixz Iyz.

    The inertia is about the centre of mass.
    """
    m = float(parameters[0])
    c = parameters[1:4] / m
    xx, xy, yy, xz, yz, zz = parameters[4:]
    S = skew(c)
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + m * S @ S
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return m, c, about[rows, columns]


def central_jacobian(parameters: FloatArray) -> FloatArray:
    """Return the (10, 10) derivatives of the central values with respect to the parameters.

    The central values are the mass, the centre of mass, and Ixx Iyy Izz Ixy Ixz Iyz about the
    centre of mass.
    """
    m, c = float(parameters[0]), parameters[1:4] / float(parameters[0])
    out = np.zeros((10, 10))
    out[0, 0] = 1.0
    out[1:4, 0], out[1:4, 1:4] = -c / m, np.eye(3) / m
    # I_c = I_o − (h·h/m)·1 + h·hᵀ/m, with I_o about the flange's origin.
    along = sum(_gradient(c, k, k) for k in range(3))
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    for row, ((i, j), source) in enumerate(zip(pairs, (4, 6, 9, 5, 7, 8), strict=True), start=4):
        out[row, source] = 1.0
        out[row] += _gradient(c, i, j) - (along if i == j else 0.0)
    return out


def _gradient(c: FloatArray, i: int, j: int) -> FloatArray:
    """Return (10,) the gradient of hᵢ·hⱼ/m with respect to the parameters."""
    row = np.zeros(10)
    row[1 + i] += c[j]
    row[1 + j] += c[i]
    row[0] = -c[i] * c[j]
    return row


def point_masses(mass: float, reach: float) -> FloatArray:
    """Return (10, 10) the parameters of ten point masses, one mass per row, that span all payloads.

    A physically consistent body stays consistent if one of these point masses is added. A step
    along a single parameter does not guarantee a consistent body.
    """
    e = reach * np.eye(3)
    places = [np.zeros(3), *e, *-e, e[0] + e[1], e[0] + e[2], e[1] + e[2]]
    return np.array([body_parameters(mass, place, np.zeros((3, 3))) for place in places])


def is_body(parameters: FloatArray) -> bool:
    """Return whether the payload parameters (10,) are physically consistent."""
    return bool(np.linalg.eigvalsh(_above_floor(parameters))[0] >= 0.0)


_LENGTHS = np.array([LENGTH_M, LENGTH_M, LENGTH_M, 1.0])


def _scaled(pseudo: FloatArray) -> FloatArray:
    scaled: FloatArray = pseudo / np.outer(_LENGTHS, _LENGTHS)
    return scaled


_UNITS = np.stack([_scaled(pseudo_inertia(unit)) for unit in np.eye(10)])

_FLOOR = np.diag([THINNEST_KGM2, THINNEST_KGM2, THINNEST_KGM2, LIGHTEST_KG])

_SCALED_FLOOR = _scaled(_FLOOR)


def _above_floor(parameters: FloatArray) -> FloatArray:
    """Return the (4, 4) scaled matrix that must be positive definite; lengths are in `LENGTH_M`."""
    above: FloatArray = np.tensordot(parameters, _UNITS, 1) - _SCALED_FLOOR
    return above


def nearest_body(X: FloatArray, y: FloatArray) -> FloatArray:
    """Return the physically consistent parameters (10,) that minimise ‖X·parameters − y‖².

    X (m, 10) must have full rank. The minimum is computed by Newton's method with a barrier −μ·log
    det of the pseudo-inertia minus its lower bound; the sum of squares is within 4μ of its minimum
    (Boyd & Vandenberghe, Convex Optimization, §11.2). An alternative with
    `scipy.optimize.least_squares` over a matrix factor of the pseudo-inertia did not converge in
    500 evaluations, because the factor is singular at the solution.
    """
    free = np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])
    if is_body(free):
        return free
    gram, phi = X.T @ X, _inside(free)
    least = float(np.sum((X @ free - y) ** 2))

    def squares() -> float:
        return least + float((phi - free) @ gram @ (phi - free))

    mu = (squares() - least) / 4
    # The gap is a share of the current sum of squares, so that a distant start has no influence.
    while mu > SMALLEST_GAP * squares() / 4:
        for _ in range(MOST_NEWTON):
            step, decrement = _newton(phi, free, gram, mu)
            phi = phi + _longest(phi, step) * step
            if decrement < 1e-6 * mu:
                break
        mu *= 0.1
    return phi


def _inside(parameters: FloatArray) -> FloatArray:
    """Return the parameters (10,) of a strictly consistent body near the passed parameters."""
    values, vectors = np.linalg.eigh(_scaled(pseudo_inertia(parameters)))
    least = max(1e-2 * float(values[-1]), 1e-3)
    near = (vectors * np.maximum(values, least)) @ vectors.T
    return from_pseudo_inertia(near * np.outer(_LENGTHS, _LENGTHS))


def _newton(
    phi: FloatArray, free: FloatArray, gram: FloatArray, mu: float
) -> tuple[FloatArray, float]:
    """Return the Newton step and half its squared decrement.

    The function minimised by the Newton step is (φ − free)ᵀ·gram·(φ − free) − μ·log det.
    """
    inverse = np.linalg.inv(_above_floor(phi))
    slopes = np.einsum("ij,kjl->kil", inverse, _UNITS)
    gradient = 2.0 * gram @ (phi - free) - mu * np.einsum("kii->k", slopes)
    hessian = 2.0 * gram + mu * np.einsum("kij,lji->kl", slopes, slopes)
    scale = 1.0 / np.sqrt(np.diag(hessian))
    # Payload parameters differ by powers of ten.
    step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
    return step, float(-gradient @ step) / 2.0


def _longest(phi: FloatArray, step: FloatArray) -> float:
    """Return the largest share of a step, at most 1, that keeps the body strictly consistent."""
    L = np.linalg.cholesky(_above_floor(phi))
    change = np.linalg.solve(L, np.linalg.solve(L, np.tensordot(step, _UNITS, 1)).T)
    lowest = float(np.linalg.eigvalsh(change)[0])
    return 1.0 if lowest > -0.9 else -0.9 / lowest
