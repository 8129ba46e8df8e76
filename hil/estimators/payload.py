"""The load of a loaded recording, identified by any fitted model of the arm without it.

A model predicts efforts from the motion and from each series' load (`payload_identified`). The load
is what makes that prediction fit: weighted least squares over its ten inertial parameters φ in the
flange frame, by Gauss–Newton, since friction may depend on the load (`estimate_payload`).

A rigid load is linear in its parameters, with the columns of `RobotModel.payload_regressor`. What a
model adds to that, such as friction that grows with the torque, is found by differences: small
point masses are added to the load, which leave it a body that can exist. Weights follow the
residuals, and what of the model's friction was another on that day is decided on stretches of time
that are left out in turn (`best_friction`).

Every solution is a body made of positive masses (`nearest_body`): its 4 × 4 pseudo-inertia [[Σ, h],
[hᵀ, m]] is positive semi-definite, Σ = ½·tr(I)·1 − I (Wensing, Kim & Slotine, IEEE RA-L 2018).

Standard errors are those of the sandwich over blocks of time (`hil.estimators.covariance`): what
the model does not know about the arm repeats for a while and then changes. The load is the
difference to an arm that was itself identified, so its variance grows by the share of samples in
which that was done; this is right for alike motions and too little for a model of poorer ones.
`payload_halves` measures what an estimate is worth: the load of one half of a recording, tested on
the other.
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
        return _estimate(*_chosen(LoadProblem.of(model, dataset, "scale", rows)))
    problem = LoadProblem.of(model, dataset, friction, rows)
    return _estimate(problem, _settled(problem))


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


def _chosen(widest: LoadProblem) -> tuple[LoadProblem, Solution]:
    """The problem with what of the friction is best freed, and its solution.

    Args:
        widest: The problem with everything freed that can be.
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
"""Weights follow the residuals; where wrong gains leave much of these, that settles slowly."""

FRESH = 5
"""Steps between Jacobians: they hardly change once the load is roughly known."""

SMALL_STEP = 1e-3
"""Settled when no prediction changes by more than this share of its joint's residual."""


class Solution(NamedTuple):
    """Where the steps ended, and the linearised prediction there."""

    step: Step
    at: Linearised


def _settled(problem: LoadProblem, start: FloatArray | None = None) -> Solution:
    """Step by step from a load (10,), or from nothing."""
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
        "the load did not settle: the recording hardly tells it",
        hint="record a motion that turns the wrist as well as the arm",
    )


def _residual(problem: LoadProblem, at: Linearised, extra: FloatArray) -> FloatArray:
    return problem.target - at.effort - (at.friction @ extra).reshape(at.effort.shape)


def rms(values: FloatArray) -> FloatArray:
    """Root mean square (n,) of values (N, n)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _estimate(problem: LoadProblem, found: Solution) -> PayloadEstimate:
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
    """Of the load's parameters, then of the correction's coefficients."""
    X = np.hstack([at.load, at.friction])
    weight = np.tile(1.0 / np.maximum(rms(residual), 1e-12) ** 2, len(residual))
    sums = ClusterSums.of(X, residual.ravel(), weight, np.repeat(blocks, residual.shape[1]))
    gram = sums.gram.sum(axis=0)
    # Parameters of a load differ by powers of ten; scaled, the inverse is safe.
    length = np.sqrt(np.diag(gram))
    scale = np.outer(length, length)
    return clustered_covariance(np.linalg.inv(gram / scale) / scale, sums, "CR2")


def _by_gain(found: Solution, residual: FloatArray) -> FloatArray:
    """(10, n) by how much the parameters fall short per share that a joint's gain is larger.

    The true effort of the load is then less by that share, at that joint alone.
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
    """(10,) of a known load, in the order of `PayloadEstimate.values`."""
    return _values(payload_parameters(payload))


GAP_S = 0.5
"""Rows so close to the cut are not fitted to: the filter of the effort sees across it."""


@dataclass(frozen=True, slots=True, eq=False)
class HalfTested:
    """An estimate and its errors on the half it did not see, against the effort as measured.

    Attributes:
        fitted: `first` or `second`, the half the load was fitted to.
        estimate: The load.
        rmse_raw: (n,) with the load.
        rmse_ignored: (n,) with nothing at the flange.
    """

    fitted: str
    estimate: PayloadEstimate
    rmse_raw: FloatArray
    rmse_ignored: FloatArray

    @property
    def mean_raw(self) -> float:
        """Mean over the joints."""
        return float(np.mean(self.rmse_raw))


def payload_halves(
    model: RobotEstimator, dataset: Dataset, *, friction: Friction | Literal["auto"] = "auto"
) -> tuple[HalfTested, HalfTested]:
    """Fit the load to each half of every series, test it on the other.

    The model sees the motion of the whole, as its memory of friction needs; the effort of the half
    tested, and of the rows next to the cut, is not looked at.

    Args:
        model: Fitted without the recording.
        dataset: Loaded recording, as measured (not yet filtered).
        friction: As in `estimate_payload`.
    """
    first, near = halves(dataset)
    return (
        _tested("first", model, dataset, first & ~near, ~first, friction),
        _tested("second", model, dataset, ~first & ~near, first, friction),
    )


def halves(dataset: Dataset) -> tuple[BoolArray, BoolArray]:
    """(N,) which rows are in the first half of their series, and which are near the cut."""
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
"""A mass is well determined when its 95 % interval reaches no further than this share of it."""

COM_REACH_M = 0.01
"""A coordinate of the centre of mass is when its interval reaches no further than this."""

INERTIA_SHARE = 0.25
"""An inertia is when its interval reaches no further than this share of the largest one."""


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """By how much friction was another on the day of the load than the model has it.

    Attributes:
        offset: (n,) constant to be added [A or N·m].
        scale: (n,) share of the model's friction to be added.
    """

    offset: FloatArray
    scale: FloatArray

    def of(self, prediction: Prediction) -> FloatArray:
        """(N, n) what is to be added to a prediction."""
        zero = np.zeros_like(prediction.effort)
        friction = prediction.components.get("friction", zero) if np.any(self.scale) else zero
        added: FloatArray = self.offset + self.scale * friction
        return added


@dataclass(frozen=True, slots=True, eq=False)
class PayloadEstimate:
    """A load identified from motion.

    Values are in the order of `NAMES`: mass, centre of mass in the flange frame, inertia about the
    centre of mass along the flange's axes.

    Attributes:
        payload: The load: always one that positive masses can make. Of an arm at rest a point mass,
            coordinates that do not show being 0; nothing where no load shows.
        values: (10,) the same as numbers; NaN for what does not show at rest.
        std_error: (10,) standard errors, given the form of the model and its drive gains; at rest
            with the errors of both.
        interval: (10, 2) 95 % intervals of Student's t by blocks of time.
        covariance: (10, 10) of the values, whose diagonal `std_error` squares.
        degrees: (10,) of Student's t.
        by_gain: (10, n) by how much a value is too small for each share by which the true gain of a
            joint's drive is above the model's, had the arm's own torques been learned with it; the
            errors above know nothing of gains.
        residual: (n,) RMS of the filtered effort less the prediction with the load.
        without: (n,) the same with nothing at the flange.
        unit: `A` or `N·m`, of the residuals.
        joint_names: Length n.
        friction: What of the model's friction was freed: `model` (nothing), `offset`, `scale`; or
            `rest`, where two approaches cancel it.
        correction: By how much, zeros where it was not.
        samples: Rows used; at rest, poses.
        blocks: Blocks of time that counted as independent; at rest, poses.
        bounded: Whether the recording alone would have had a body that cannot be; the errors are
            those without that knowledge.
        gain_share: Standard deviation of a drive gain that the errors know of, as a share of it.
        other_arm: What speaks against believing it at all: the recording is of another individual
            than the model.
        notes: For people.
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
        """Itself in a notebook: a row per parameter that shows."""
        rows = [
            (one["name"], number(one["value"]), number(one["std_error"]),
             " … ".join(map(number, one["interval_95"])), "yes" if one["determined"] else "no")
            for one in self.to_dict()["parameters"]
            if one["value"] is not None
        ]  # fmt: skip
        head = ("parameter", "value", "± std", "95 % interval", "well determined")
        warned = [f"Not to be relied on: {self.other_arm}"] if self.other_arm else []
        facts = {"samples": self.samples, "independent": self.blocks, "friction": self.friction}
        notes = [*warned, *self.notes]
        return card("Load", f"{self.values[0]:.3g} kg", facts, table=(head, rows), notes=notes)

    def with_gains(self, share: float) -> PayloadEstimate:
        """The same with errors that know of the gains, independent from joint to joint.

        Args:
            share: Standard deviation of a drive gain [share of it]. Torques have no gains.
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
        """Which of the ten the recording tells well, by name."""
        reach = (self.interval[:, 1] - self.interval[:, 0]) / 2
        largest = float(np.max(np.abs(self.values[4:7]), initial=0.0))
        limit = np.array(
            [MASS_SHARE * self.values[0], *3 * [COM_REACH_M], *6 * [INERTIA_SHARE * largest]]
        )
        return dict(zip(NAMES, (reach <= limit).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil payload --json`."""
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
    """JSON has no NaN."""
    return float(value) if np.isfinite(value) else None


PROBE = 1e-3
"""Point masses of the differences, as a share of the load's mass."""

ROUNDING = 1e-9
"""Effort beyond a rigid load's that all probes together have to make, or there is none."""

LEAST_ROWS = 200


def with_identified(dataset: Dataset, payload: Payload) -> Dataset:
    """The same samples, with this load instead of the declared one."""
    conditions = tuple(replace(c, payload_identified=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)


class Linearised(NamedTuple):
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
class LoadProblem:
    """What does not change from step to step.

    Attributes:
        model: The model of the arm.
        data: Filtered, every row.
        keep: (N,) rows that count.
        kept: The rows that count.
        bare: Their prediction with nothing mounted.
        rigid: (M·n, 10) derivative of the effort by a rigid load alone.
        friction: See `hil.estimators.payload.estimate_payload`.
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
        """Filter a recording as the model was fitted, and take the rows (N,) that count.

        Raises:
            FitError: They are too few.
            DataError: The recording is not for this model.
        """
        data = _filtered(model, dataset)
        bare = model.predict(with_identified(data, Payload()))
        keep = np.all(bare.valid, axis=1)
        if rows is not None:
            keep = keep & np.asarray(rows, dtype=bool)
        kept = rows_of(data, keep)
        if len(kept) < LEAST_ROWS:
            raise FitError(
                f"{len(kept)} rows are too few to tell a load: at least {LEAST_ROWS} are needed",
                hint="record the arm with the load on a motion of some seconds",
            )
        W = model.robot_.payload_regressor(*(kept[name] for name in MOTION))
        rigid = W / np.tile(model.torque_scale_, len(kept))[:, None]
        return LoadProblem(model, data, keep, kept, _only(bare, keep), rigid, friction)

    @property
    def target(self) -> FloatArray:
        """(M, n) measured effort, filtered."""
        return self.kept["effort_f"]

    def predict(self, parameters: FloatArray) -> Prediction:
        """Of the rows that count, under a load (10,)."""
        load = payload_of(parameters)
        return _only(self.model.predict(with_identified(self.data, load)), self.keep)

    def columns(self, prediction: Prediction) -> FloatArray:
        """(M·n, k) of the correction of friction."""
        terms = {"offset": np.ones_like(prediction.effort)}
        if self.friction == "scale" and "friction" in prediction.components:
            terms["scale"] = prediction.components["friction"]
        if self.friction == "model":
            return np.empty((prediction.effort.size, 0))
        return joint_columns(terms)

    def jacobian(self, parameters: FloatArray, here: Prediction) -> FloatArray:
        """(M·n, 10) derivative at a load, all that the model adds to a rigid one included.

        Eleven predictions where it adds something, one where it does not.
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
        """(M·n,) by how much a prediction changes more than the torque of a rigid load."""
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
"""Inertial parameters of a load."""


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


def best_load(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray
) -> Step:
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


def _weighted(
    at: Linearised, parameters: FloatArray, target: FloatArray, sigma: FloatArray
) -> FloatArray:
    """(M·n, k + 11) columns of friction, load and target, in standard deviations."""
    wanted = (target - at.effort).ravel() + at.load @ parameters
    weight = np.tile(1.0 / sigma, len(target))[:, None]
    return np.column_stack([at.friction, at.load, wanted]) * weight


FOLDS = 5
"""Stretches of every series that are left out in turn to choose."""

LEAST_GAIN = 0.01
"""What freeing more has to take off the error left out, as a share of its square."""


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
    """Sum of squares of every triangle's rows by the solution to all others."""
    total = 0.0
    for fold, own in enumerate(triangles):
        others = np.vstack([R for number, R in enumerate(triangles) if number != fold])
        found = _solved(upper_triangle(others[:, columns]))
        whole = np.concatenate([found.extra, found.parameters, [-1.0]])
        total += float(np.sum((own[:, columns] @ whole) ** 2))
    return total


def _stretches(offsets: IntArray) -> IntArray:
    """(M,) number of the stretch each row is in."""
    lengths = np.diff(offsets).tolist()
    return np.concatenate([np.arange(rows) * FOLDS // max(rows, 1) for rows in lengths])


LENGTH_M = 0.1
"""What a load's dimensions are counted in, so that its numbers are alike in size."""

THINNEST_KGM2 = 1e-7
"""Least second moment in every direction: a body is no point, and rounding must not make it less
than one."""

LIGHTEST_KG = 1e-4
"""Nothing has no centre of mass, so a fit does not get to nothing."""

SMALLEST_GAP = 1e-6
"""How near a sum of squares comes to its minimum, as a share of itself."""

MOST_NEWTON = 30


def payload_of(parameters: FloatArray) -> Payload:
    """The load with these parameters; its mass must be above 0."""
    m, c, I = central(parameters)  # noqa: E741
    x, y, z = (float(value) for value in c)
    xx, yy, zz, xy, xz, yz = (float(value) for value in I)
    return Payload(float(m), (x, y, z), (xx, yy, zz, xy, xz, yz))


def central(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Mass, centre of mass (3,) and Ixx Iyy Izz Ixy Ixz Iyz (6,) about it."""
    m = float(parameters[0])
    c = parameters[1:4] / m
    xx, xy, yy, xz, yz, zz = parameters[4:]
    S = skew(c)
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + m * S @ S
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return m, c, about[rows, columns]


def central_jacobian(parameters: FloatArray) -> FloatArray:
    """(10, 10) how m, cx, cy, cz, Ixx Iyy Izz Ixy Ixz Iyz (central) follow the parameters."""
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
    """(10,) of hᵢ·hⱼ/m."""
    row = np.zeros(10)
    row[1 + i] += c[j]
    row[1 + j] += c[i]
    row[0] = -c[i] * c[j]
    return row


def point_masses(mass: float, reach: float) -> FloatArray:
    """(10, 10) rows of parameters of ten point masses that together span all loads.

    Added to a body they leave it one, which a step along a single parameter need not.
    """
    e = reach * np.eye(3)
    places = [np.zeros(3), *e, *-e, e[0] + e[1], e[0] + e[2], e[1] + e[2]]
    return np.array([body_parameters(mass, place, np.zeros((3, 3))) for place in places])


def is_body(parameters: FloatArray) -> bool:
    """Whether positive masses could have these parameters."""
    return bool(np.linalg.eigvalsh(_above_floor(parameters))[0] >= 0.0)


_LENGTHS = np.array([LENGTH_M, LENGTH_M, LENGTH_M, 1.0])


def _scaled(pseudo: FloatArray) -> FloatArray:
    scaled: FloatArray = pseudo / np.outer(_LENGTHS, _LENGTHS)
    return scaled


_UNITS = np.stack([_scaled(pseudo_inertia(unit)) for unit in np.eye(10)])

_FLOOR = np.diag([THINNEST_KGM2, THINNEST_KGM2, THINNEST_KGM2, LIGHTEST_KG])

_SCALED_FLOOR = _scaled(_FLOOR)


def _above_floor(parameters: FloatArray) -> FloatArray:
    """(4, 4) what has to be positive definite, lengths in `LENGTH_M`."""
    above: FloatArray = np.tensordot(parameters, _UNITS, 1) - _SCALED_FLOOR
    return above


def nearest_body(X: FloatArray, y: FloatArray) -> FloatArray:
    """(10,) parameters of the body that minimises ‖X·parameters − y‖², X (m, 10) of full rank.

    Newton's method with a barrier −μ·log det of what the pseudo-inertia is above its floor; the
    sum of squares is within 4μ of its minimum (Boyd & Vandenberghe, Convex Optimization, §11.2).
    As a least-squares problem in a factor of the pseudo-inertia, which is singular at the solution,
    `scipy.optimize.least_squares` has not converged after 500 evaluations.
    """
    free = np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])
    if is_body(free):
        return free
    gram, phi = X.T @ X, _inside(free)
    least = float(np.sum((X @ free - y) ** 2))

    def squares() -> float:
        return least + float((phi - free) @ gram @ (phi - free))

    mu = (squares() - least) / 4
    # A start far away must not count: the gap is a share of what the sum of squares is now.
    while mu > SMALLEST_GAP * squares() / 4:
        for _ in range(MOST_NEWTON):
            step, decrement = _newton(phi, free, gram, mu)
            phi = phi + _longest(phi, step) * step
            if decrement < 1e-6 * mu:
                break
        mu *= 0.1
    return phi


def _inside(parameters: FloatArray) -> FloatArray:
    """(10,) a body near the parameters, well inside what can be."""
    values, vectors = np.linalg.eigh(_scaled(pseudo_inertia(parameters)))
    least = max(1e-2 * float(values[-1]), 1e-3)
    near = (vectors * np.maximum(values, least)) @ vectors.T
    return from_pseudo_inertia(near * np.outer(_LENGTHS, _LENGTHS))


def _newton(
    phi: FloatArray, free: FloatArray, gram: FloatArray, mu: float
) -> tuple[FloatArray, float]:
    """The step, and half its decrement squared, of (φ − free)ᵀ·gram·(φ − free) − μ·log det."""
    inverse = np.linalg.inv(_above_floor(phi))
    slopes = np.einsum("ij,kjl->kil", inverse, _UNITS)
    gradient = 2.0 * gram @ (phi - free) - mu * np.einsum("kii->k", slopes)
    hessian = 2.0 * gram + mu * np.einsum("kij,lji->kl", slopes, slopes)
    scale = 1.0 / np.sqrt(np.diag(hessian))
    # Parameters of a load differ by powers of ten.
    step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
    return step, float(-gradient @ step) / 2.0


def _longest(phi: FloatArray, step: FloatArray) -> float:
    """Share of a step, 1 at most, that stays well inside."""
    L = np.linalg.cholesky(_above_floor(phi))
    change = np.linalg.solve(L, np.linalg.solve(L, np.tensordot(step, _UNITS, 1)).T)
    lowest = float(np.linalg.eigvalsh(change)[0])
    return 1.0 if lowest > -0.9 else -0.9 / lowest
