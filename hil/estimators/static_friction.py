"""Static friction models that use the approach path into each pose.

The friction of a sliding joint is −F·sign(q̇). If the joint stops, the bristles of Dahl's model
stay bent; if the joint then slides back by some tenths of a millirad, the bristles relax. The
recording contains this slide back with a resolution of a tenth of a millirad, and therefore
determines the remaining friction. The friction columns are fitted together with gravity and offset,
for all joints at once in N·m. The measured current of a predicted pose is never an input of the
prediction.

- `StaticFriction` is the base class, which contains the selection of columns, payloads, predictions
  and streams.
- `StaticCoulomb` (`static-coulomb`) has a single level of dry friction per joint, i·K = g(q) +
  offset + Fc·sign(approach). The term Fc·sign(approach) explains most of the static effort that
  gravity does not explain.
- `StaticHysteresis` (`static-hysteresis`) computes friction states along the measured path.
  Friction states with several lengths describe contacts that release one after the other. Each
  friction term may increase with the torque through the gear and change with temperature. A linear
  correction, whose inputs are the paths, describes the friction that the terms do not explain; its
  strength is chosen by holding out poses of the *training* data. If memory does not reduce the
  error on held-out training poses, for example because no joint slides back, the memory terms are
  left out.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from scipy.signal import savgol_filter

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.data import (
    ARRIVAL_POINTS,
    ARRIVAL_Q,
    ARRIVAL_QD,
    AT_REST,
    Dataset,
    Prediction,
    SeriesKind,
    Stream,
    approach_directions,
)
from hil.dynamics import RobotModel, joint_columns
from hil.estimators.base import payload_torque
from hil.estimators.checks import Needs
from hil.estimators.friction_memory import states_at_rest
from hil.estimators.least_squares import GroupedRidge, pose_folds
from hil.estimators.parameters import flag, number, parameter
from hil.estimators.standstill import resting_at
from hil.estimators.static_model import StaticModel, one_row_each, pose_numbers
from hil.estimators.streaming import ApproachMemory, SampleStream

FIRST_TERMS = ("offset", "coulomb")
"""Terms of a first fit, from which the gravity torque and thereby the joint loads are computed."""

FARTHEST_LOAD = 2.0
"""Maximum load in the friction columns, as a multiple of the largest load in training.

A joint that had nearly no load in training, such as the last joint of an arm without payload, has
an uncertain load dependence.
"""

NOTHING = 1e-9
"""Magnitude below which a column counts as zero, in the unit of the column.

For example, the load columns of joint 1 of an upright arm are zero, because this joint bears no
load.
"""


class StaticFriction(StaticModel):
    """Base class of static models with gravity, offset and friction columns, in N·m.

    Attributes:
        load_gravity_: (p,) gravity parameters from which the loads in the columns are computed.
        load_limit_: (n,) largest torque in the columns [N·m], see `FARTHEST_LOAD`.
        celsius_: (n,) mean joint temperatures in training [°C]; NaN if they were not measured
            or nearly constant.
        period_: Time between samples in training [s].
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",),)
    tells_friction: ClassVar[bool] = True

    load_gravity_: FloatArray
    load_limit_: FloatArray
    celsius_: FloatArray
    period_: float

    form = "shared"
    current_term = False

    @abstractmethod
    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        """Return the friction columns (D, n) by name; the names are always the same."""

    def _drive_terms(self, q: FloatArray, load: FloatArray) -> dict[str, FloatArray]:
        """Return the columns (N, n) of drive effects by name, for positions and loads (N, n)."""
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: two dwells for each parameter of a joint.

        Each pose gives one row per joint, and every joint has separate terms.
        """
        still = np.zeros((1, 1))
        unmoved = Rest(still, still, np.zeros((1, SMOOTHED, 2, 1)), still)
        terms = {"offset", *self._drive_terms(still, still), *self._terms(unmoved)}
        return Needs({"dwells": 2 * len(terms)}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to the dwells of the data.

        Dwells with an unknown approach direction of any joint are left out; `notes_` reports the
        number of these dwells.

        Raises:
            FitError: The data are too few, not finite, or of a different robot or unit, do not
                contain the approach directions of the poses, or do not excite all parameters.
        """
        rows = self._approached(one_row_each(self._dwells(dataset, robot)))
        self.samples_ = len(rows)
        self.period_ = period(dataset["t"])
        self.celsius_ = mean_celsius(rows)
        self.load_gravity_ = np.zeros(len(self._form.names))
        self.load_limit_ = np.full(rows.n_joints, np.inf)
        self._choose_terms(rows, only=FIRST_TERMS)
        self.needs(robot).require(dwells=self.samples_)
        self._solve(rows, weighted=True)
        self.load_gravity_ = self.coefficients_[: len(self._form.names)]
        self.load_limit_ = FARTHEST_LOAD * np.max(np.abs(self.rest(rows).load), axis=0)
        self._choose_terms(rows)
        self._solve(rows, weighted=True)
        self._learn(rows)
        return self

    def _learn(self, rows: Dataset) -> None:
        """Fit the additional parameters of a subclass to dwells with one row each."""

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the effort of every row: gravity, offset, drive, friction and payload components.

        Friction is predicted for dwells with a known approach direction. In all other rows,
        friction is 0 and the prediction is marked as not valid.

        Raises:
            DataError: Robot or unit of the data differ from those of the model.
        """
        self.require_match(dataset)
        still, joints = np.zeros_like(dataset["q"]), dataset.n_joints
        base = self._predict(dataset, dataset["q"], still, still)
        parts = {name: np.array(part) for name, part in base.components.items()}
        if drive := self._drive_terms(dataset["q"], self._load(dataset)):
            parts["drive"] = self._weighted(drive)
        parts["friction"] = np.zeros_like(still)
        std, valid = np.full_like(still, np.nan), np.zeros((len(dataset), joints), dtype=bool)
        dwells, at, number = dwells_in(dataset)
        if len(number):
            friction, deviation, known = self._friction(one_row_each(dwells))
            parts["friction"][at] = friction[number]
            std[at], valid[at] = deviation[number], known[number]
        effort: FloatArray = np.sum(list(parts.values()), axis=0)
        return Prediction(effort, std, valid & np.isfinite(effort), parts)

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, at the sample rate of the training data.

        The predictor detects from the positions when and how the arm stops. During motion, the
        predicted friction is 0.
        """
        load = payload or Payload()

        def friction(path: FloatArray, q: FloatArray) -> FloatArray:
            return self._friction(replace(resting_at(self, q, load), arrivals=path))[0]

        def effort(q: FloatArray, qd: FloatArray, qdd: FloatArray, held: FloatArray) -> FloatArray:
            parts = [*self._parts(q, q, q).values()]
            if drive := self._drive_terms(q, self._load(resting_at(self, q, load))):
                parts.append(self._weighted(drive))
            if not load.is_empty:
                parts.append(self._load_effort(load, q, np.zeros_like(q), np.zeros_like(q)))
            whole: FloatArray = np.sum(parts, axis=0) + held
            return whole

        memory = ApproachMemory(friction, self.rest_speed, self.period_)
        return SampleStream(self.robot_.n, memory, effort)

    def dry_friction(self) -> FloatArray:
        """Return (n,) the level of dry friction of an unloaded joint [N·m]."""
        own = dict(zip(self.parameter_names_, self.coefficients_.tolist(), strict=True))
        return np.array(
            [abs(sum(own.get(f"{j}.{t}", 0.0) for t in self._dry())) for j in self.joint_names_]
        )

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a linear model, and the values that define the columns."""
        return super().fitted_arrays() | {
            "load_gravity": self.load_gravity_,
            "load_limit": self.load_limit_,
            "celsius": self.celsius_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a linear model, the sample time and the names of all terms."""
        own = {"period_s": self.period_, "terms": list(self._names)}
        return super().fitted_facts() | own

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        self.load_gravity_, self.load_limit_ = arrays["load_gravity"], arrays["load_limit"]
        self.celsius_ = arrays["celsius"]
        self.period_ = float(facts["period_s"])
        super().restore(arrays, facts)
        self._take_names(self.parameter_names_, tuple(facts["terms"]))
        still = np.zeros((1, self.robot_.n))
        lacks = {*self._dry(), *self._drive_terms(still, still)} - set(self._names)
        if lacks or int(self._alive.sum()) != len(self.coefficients_) - len(self._form.names):
            raise ValueError(f"terms: {facts['terms']!r:.60}")

    def _dry(self) -> tuple[str, ...]:
        """Return the names of the terms whose sum is the dry friction of an unloaded joint."""
        return ("coulomb",)

    def _approached(self, rows: Dataset) -> Dataset:
        """Return the dwells with a known approach direction of every joint."""
        paths = rows.arrivals if rows.arrivals is not None else unknown_paths(rows)
        if np.isinf(paths).any():
            raise FitError(
                "the approach paths of the dwells contain infinite values",
                hint="load the recording again: positions and velocities must be finite",
            )
        known = approach_directions(paths) != 0
        if not known.any():
            raise FitError(
                f"{self.estimator} needs the approach directions of the poses, but the data do "
                "not contain the motion before the dwells",
                hint="record the moves as well (hil run does), or fit static-wls",
            )
        if not known.any(axis=0).all():
            names = [rows.joint_names[j] for j in np.flatnonzero(~known.any(axis=0))]
            raise FitError(
                f"{', '.join(names)} did not move before any of the dwells, so the direction of "
                "its friction is unknown",
                hint="record a program in which every joint moves, or fit static-wls",
            )
        whole = known.all(axis=1)
        left_out = len(whole) - int(whole.sum())
        note = (
            f"{left_out} of {len(whole)} dwells are left out: the approach direction of a joint "
            "is not in the data"
        )
        self.notes_ = (note,) if left_out else ()
        return rows.take(np.flatnonzero(whole))

    def _choose_terms(self, rows: Dataset, only: Sequence[str] = ()) -> None:
        """Set the parameter names to the terms that are linearly independent of earlier terms.

        Examples of dependent terms: joint 1 of an upright arm bears no load, and if no joint slides
        back, all friction states equal the sign of the approach direction. The gain term of the
        joint with the largest load is left out: a common factor of all drive gains cannot be
        separated from the gravity parameters.
        """
        terms = self._columns(rows)
        heaviest, names = int(np.argmax(self.load_limit_)), list(self._form.names)
        for j, joint in enumerate(self.joint_names_):
            own = {
                term: values[:, j]
                for term, values in terms.items()
                if (not only or term in only)
                and (term != GAIN or j != heaviest)
                and np.max(np.abs(values[:, j])) > NOTHING
            }
            is_new = independent(np.stack(list(own.values()), axis=1)).tolist()
            names += [f"{joint}.{term}" for term, new in zip(own, is_new, strict=True) if new]
        self._take_names(tuple(names), tuple(terms))

    def _take_names(self, parameters: tuple[str, ...], terms: tuple[str, ...]) -> None:
        known = set(parameters)
        self.parameter_names_, self._names = parameters, terms
        self._alive: BoolArray = np.array(
            [[f"{joint}.{term}" in known for term in terms] for joint in self.joint_names_]
        )

    def _columns(self, rows: Dataset) -> dict[str, FloatArray]:
        rest = self.rest(rows)
        drive = self._drive_terms(rows["q"], rest.load)
        return {"offset": np.ones_like(rows["q"])} | drive | self._terms(rest)

    def _weighted(self, columns: dict[str, FloatArray]) -> FloatArray:
        """Return (D, n) the sum of the columns times their coefficients, in effort units."""
        own = np.zeros(self._alive.shape)  # 0 for terms that a joint lacks
        own[self._alive] = self.coefficients_[len(self._form.names) :]
        total: FloatArray = sum(
            (values * own[:, self._names.index(term)] for term, values in columns.items()),
            start=np.zeros(()),
        )
        return total / self.torque_scale_

    def _load(self, data: Dataset) -> FloatArray:
        """Return (N, n) the torque of gravity and payload [N·m], limited by `load_limit_`."""
        q, still = data["q"], np.zeros_like(data["q"])
        gravity = (self._form.columns(q) @ self.load_gravity_).reshape(q.shape)
        load = gravity + payload_torque(self.robot_, data, q, still, still)
        return np.where(
            np.abs(load) > NOTHING, np.clip(load, -self.load_limit_, self.load_limit_), 0.0
        )

    def rest(self, rows: Dataset) -> Rest:
        """Return the inputs of the columns, for dwells with one row each."""
        paths = rows.arrivals if rows.arrivals is not None else unknown_paths(rows)
        warmer = np.nan_to_num(celsius(rows) - self.celsius_)
        return Rest(self._load(rows), approach_directions(paths), np.nan_to_num(paths), warmer)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        q, still = data["q"], np.zeros_like(data["q"])
        own = joint_columns(self._columns(data))[:, self._alive.ravel()]
        W = np.hstack([self._form.columns(q), own])
        load = payload_torque(self.robot_, data, q, still, still)
        yield slice(0, len(data)), W, data["effort"] * self.torque_scale_ - load

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        gravity = self._form.columns(q) @ self.coefficients_[: len(self._form.names)]
        return {
            "gravity": gravity.reshape(q.shape) / self.torque_scale_,
            "offset": self._weighted({"offset": np.ones_like(q)}),
        }

    def _friction(self, rows: Dataset) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return friction and standard deviation, in effort units, and a mask of known values."""
        rest = self.rest(rows)
        friction = self._weighted(self._terms(rest))
        return friction, np.broadcast_to(self.sigma_, friction.shape), rest.direction != 0


class StaticCoulomb(StaticFriction):
    """Static model with gravity, offset and Coulomb friction by approach direction."""

    estimator: ClassVar[str] = "static-coulomb"

    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        return {"coulomb": rest.direction}


LENGTHS_RAD = (0.7e-4, 1.4e-4, 2.8e-4, 5.6e-4)
"""Default lengths of Dahl's states [rad].

The shortest length is a third of the resolution of the finest arm encoders; the longest length is
the compliance of gears.
"""


def _lengths(name: str, value: Any) -> tuple[float, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise SpecError(f"{name} is {value!r}, but must be a list of lengths")
    return tuple(number(name, length, above=0.0) for length in value)


_ARRAYS = ("mean", "scale", "weights", "leverage")


class StaticHysteresis(StaticFriction):
    """Static model whose friction has memory and depends on load and temperature.

    Attributes:
        penalty_: (n,) penalty of the linear correction.
        sigma_: (n,) residual standard deviation on poses held out from the correction, in effort
            units.
    """

    estimator: ClassVar[str] = "static-hysteresis"

    lengths_rad: tuple[float, ...] = parameter(
        LENGTHS_RAD, _lengths, doc="Lengths of the Dahl states [rad]."
    )
    gear_ratio: float | None = parameter(
        None,
        number,
        above=0.0,
        optional=True,
        doc="Motor turns per joint turn, for gear ripple at one and two periods per motor turn; "
        "None leaves out the ripple.",
    )
    correction: bool = parameter(
        True,
        flag,
        doc="Test the columns on held-out poses of the training data, and correct the remaining "
        "error from the approach paths; False uses the columns unchanged.",
    )

    _corrections: tuple[GroupedRidge, ...] = ()

    def _learn(self, rows: Dataset) -> None:
        self._corrections, self.penalty_ = (), np.empty(0)
        if not self.correction:
            return
        groups = pose_numbers(rows)
        left = self._out_of_pose(rows, groups)
        if left is None:
            return self._leave_memory_out(rows)
        features = correction_features(self.rest(rows))
        self._corrections = tuple(
            GroupedRidge.fit(features[j], left[:, j], groups) for j in range(rows.n_joints)
        )
        self.penalty_ = np.array([one.penalty for one in self._corrections])
        unseen = np.stack([one.residual for one in self._corrections])
        self.sigma_ = np.sqrt(np.mean(unseen**2, axis=1))

    def _out_of_pose(self, rows: Dataset, groups: IntArray) -> FloatArray | None:
        """Return (D, n) the residual of each pose, predicted by a fit that left out this pose.

        None is returned if friction with memory is less accurate on held-out poses than a constant
        level of friction, or if there are too few poses.
        """
        plain, own = StaticCoulomb(rest_speed=self.rest_speed), self._uncorrected()
        left = {model.estimator: np.empty_like(rows["effort"]) for model in (plain, own)}
        for rest, out in pose_folds(groups):
            seen, unseen = rows.take(np.flatnonzero(rest)), rows.take(np.flatnonzero(out))
            for model in (plain, own):
                try:
                    model.fit(seen, self.robot_)
                except FitError:
                    return None
                left[model.estimator][out] = unseen["effort"] - model.predict(unseen).effort
        squares = [np.mean(values**2, axis=0) for values in left.values()]
        better = float(np.mean(np.log(squares[1] / np.maximum(squares[0], 1e-300)))) < 0.0
        return left[self.estimator] if better else None

    def _uncorrected(self) -> StaticHysteresis:
        return StaticHysteresis(**{**self.get_params(), "correction": False})

    def _leave_memory_out(self, rows: Dataset) -> None:
        """Fit only the terms of `static-coulomb`, and add a note about this restriction."""
        self._choose_terms(rows, only=FIRST_TERMS)
        self._solve(rows, weighted=True)
        note = (
            "friction with memory is left out: on held-out poses of the training data it "
            "predicted no better than one friction level, or there are too few poses for a "
            "comparison"
        )
        self.notes_ = (*self.notes_, note)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a linear model, and the arrays of the corrections."""
        own = {
            f"correction_{name}": np.stack([getattr(one, name) for one in self._corrections])
            for name in (_ARRAYS if self._corrections else ())
        }
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a linear model, and the penalties of the corrections."""
        penalties = [one.penalty for one in self._corrections]
        return super().fitted_facts() | {"correction_penalty": penalties}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        penalties = [float(penalty) for penalty in facts["correction_penalty"]]
        if penalties and len(penalties) != self.robot_.n:
            raise ValueError(
                f"correction_penalty: {len(penalties)} values for {self.robot_.n} joints"
            )
        self.penalty_ = np.array(penalties)
        kept = {name: arrays[f"correction_{name}"] for name in (_ARRAYS if penalties else ())}
        self._corrections = tuple(
            GroupedRidge(
                **{name: array[j] for name, array in kept.items()},
                penalty=penalty,
                residual=np.empty(0),
            )
            for j, penalty in enumerate(penalties)
        )

    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        return memory_terms(rest, self.lengths_rad)

    def _drive_terms(self, q: FloatArray, load: FloatArray) -> dict[str, FloatArray]:
        return drive_terms(q, load, self.gear_ratio)

    def _dry(self) -> tuple[str, ...]:
        return ("coulomb", *(f"memory{k + 1}" for k in range(len(self.lengths_rad))))

    def _friction(self, rows: Dataset) -> tuple[FloatArray, FloatArray, BoolArray]:
        friction, deviation, known = super()._friction(rows)
        if not self._corrections:
            return friction, deviation, known
        features = correction_features(self.rest(rows))
        pairs = list(zip(self._corrections, features, strict=True))
        corrected = friction + np.stack([one.predict(X) for one, X in pairs], axis=1)
        spread = np.stack([1.0 + one.leverages(X) for one, X in pairs], axis=1)
        return np.where(known, corrected, friction), deviation * np.sqrt(spread), known


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Static poses with one row each, with the approach path of each joint.

    Attributes:
        load: (D, n) torque of gravity and payload [N·m], from the first fit.
        direction: (D, n) approach direction: +1 from below, −1 from above, 0 if unknown.
        paths: (D, K, 2, n) approach paths, see `hil.data.arrival`; 0 if unknown.
        warmer: (D, n) joint temperatures minus the mean in training [K]; 0 if unknown.
    """

    load: FloatArray
    direction: FloatArray
    paths: FloatArray
    warmer: FloatArray


GAIN = "gain"


def drive_terms(q: FloatArray, load: FloatArray, gear_ratio: float | None) -> dict[str, FloatArray]:
    """Return the columns (N, n) of drive effects by name; these columns do not depend on friction.

    Args:
        q: (N, n) positions [rad].
        load: (N, n) load torque of the joints [N·m].
        gear_ratio: Motor turns per joint turn, for the ripple of the gear; None for no ripple.

    Returns:
        The columns are `gain` (τ: error of a drive gain relative to those of the other joints),
        `square` (τ·|τ|: eq. 16 solved for the current, to first order), and `ripple…`.
    """
    terms = {GAIN: load, "square": load * np.abs(load)}
    for turns in (1, 2) if gear_ratio is not None else ():
        phase = turns * (gear_ratio or 0.0) * q
        terms |= {f"ripple{turns}_sin": np.sin(phase), f"ripple{turns}_cos": np.cos(phase)}
    return terms


def memory_terms(rest: Rest, lengths_rad: Sequence[float]) -> dict[str, FloatArray]:
    """Return the columns (D, n) of `coulomb` and `memory1…` by name.

    Each of these columns also occurs multiplied by the load and by the temperature.

    Args:
        rest: Static poses with their approach paths.
        lengths_rad: Lengths x of Dahl's states [rad].
    """
    states = states_at_rest(smooth(rest.paths[:, :, ARRIVAL_Q]), lengths_rad)
    named = {"coulomb": rest.direction}
    named |= {f"memory{k + 1}": state for k, state in enumerate(states)}
    terms = {}
    for name, state in named.items():
        terms[name] = state
        terms[f"{name}_load"] = state * np.abs(rest.load)
        terms[f"{name}_temperature"] = state * rest.warmer
    return terms


def correction_features(rest: Rest) -> FloatArray:
    """Return (n, D, F) the inputs of the linear correction of each joint.

    The inputs are position and velocity of the joint at each point of its path, and the position
    times the load of the joint. Further inputs use the loads of all joints: the load, the load
    times its magnitude, the magnitude times the approach direction of the joint, and the
    temperatures times this direction. Loads and temperatures of all joints describe how the stop of
    one joint affects other joints.
    """
    position, speed = rest.paths[:, :, ARRIVAL_Q], rest.paths[:, :, ARRIVAL_QD]
    magnitude = np.abs(rest.load)
    shared = np.hstack([rest.load, rest.load * magnitude])
    found = []
    for j in range(rest.load.shape[1]):
        own, side = position[:, :, j], rest.direction[:, [j]]
        columns = (own, speed[:, :, j], own * magnitude[:, [j]], shared)
        found.append(np.hstack([*columns, side * magnitude, side * rest.warmer]))
    return np.stack(found)


SMOOTHED = 7
"""Number of path points in the fit of each local parabola.

The encoder noise is a tenth of the slide back. Without smoothing of the path, Dahl's states would
treat every step of the noise as a motion.
"""


def smooth(paths: FloatArray) -> FloatArray:
    """Return (D, K, n) the approach paths smoothed by local parabolas."""
    smoothed: FloatArray = savgol_filter(paths, SMOOTHED, 2, axis=1)
    return smoothed


def celsius(rows: Dataset) -> FloatArray:
    """Return (D, n) the joint temperatures [°C]; NaN if they were not measured."""
    return rows.columns.get("temperature", np.full_like(rows["q"], np.nan))


LEAST_SPAN_K = 1.0
"""Minimum temperature range in training for which a temperature dependence is fitted [K]."""


def mean_celsius(rows: Dataset) -> FloatArray:
    """Return (n,) the mean joint temperatures [°C]; NaN if unknown or nearly constant."""
    found = np.full(rows.n_joints, np.nan)
    for j, measured in enumerate(celsius(rows).T):
        known = measured[np.isfinite(measured)]
        if len(known) and np.ptp(known) >= LEAST_SPAN_K:
            found[j] = np.mean(known)
    return found


def period(t: FloatArray) -> float:
    """Return the median time between samples at times t (N,) [s]; NaN without increasing times."""
    steps = np.diff(t)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else np.nan


def unknown_paths(rows: Dataset) -> FloatArray:
    """Return (S, K, 2, n) approach paths that contain only NaN."""
    return np.full((len(rows.conditions), ARRIVAL_POINTS, 2, rows.n_joints), np.nan)


def dwells_in(dataset: Dataset) -> tuple[Dataset, BoolArray, IntArray]:
    """Return the non-empty dwells, the mask (N,) of their rows, and the dwell index of each row."""
    there = np.diff(dataset.offsets) > 0
    at_rest = np.array([c.kind in AT_REST for c in dataset.conditions], dtype=bool)
    chosen = at_rest & there
    series = dataset.series_index()
    at = chosen[series]
    return dataset.take(np.flatnonzero(chosen)), at, (np.cumsum(chosen) - 1)[series[at]]


LEAST_OWN = 1e-4
"""Minimum share of a column that is independent of earlier columns, to use the column."""


def independent(columns: FloatArray) -> BoolArray:
    """Return (k,) a mask of the columns (D, k) that are linearly independent of earlier columns."""
    basis = np.empty((len(columns), 0))
    kept = []
    for column in columns.T:
        left = column
        for _ in range(2):  # the second pass removes rounding errors of nearly dependent columns
            left = left - basis @ (basis.T @ left)
        size, own = float(np.linalg.norm(column)), float(np.linalg.norm(left))
        kept.append(own > LEAST_OWN * size)
        if kept[-1]:
            basis = np.column_stack([basis, left / own])
    return np.array(kept, dtype=bool)
