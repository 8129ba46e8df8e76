"""Friction of an arm at rest: models that know from where, and how, the arm came to its pose.

A joint that slides has friction −F·sign(q̇). When it stops, the bristles of Dahl's model stay bent,
and a slide back by some tenths of a millirad unbends them. How far a joint slid back is in the
recording, a tenth of a millirad of it, and says how much of its friction is left. Columns of that
friction are fitted together with gravity and offset, for all joints at once in N·m; the current of
the pose that is predicted is nowhere among the inputs.

- `StaticFriction` is the base: which columns say something, loads, predictions, streams.
- `StaticCoulomb` (`static-coulomb`) knows one level of dry friction per joint, i·K = g(q) + offset
  + Fc·sign(approach), the baseline with a direction. Most of what gravity alone leaves unexplained
  at rest is this.
- `StaticHysteresis` (`static-hysteresis`) carries friction states along the measured path. Several
  lengths side by side describe contacts that let go one after the other; each share may grow with
  the torque that the gear transmits and change with temperature. A linear correction by the paths,
  its strength chosen by holding out poses of the *training* data, takes up what their form misses.
  Where memory does not help on such poses, as without any slide back, it is left out.
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
"""What a first fit knows, before loads are known; gravity from it gives the loads."""

FARTHEST_LOAD = 2.0
"""Friction goes with the load up to so many times the largest one in training: a joint that bore
next to none, as the last one of an arm without a load, knows next to nothing about it."""

NOTHING = 1e-9
"""A column smaller than this everywhere, in its own unit, is none: joint 1 of an upright arm bears
no load."""


class StaticFriction(StaticModel):
    """Gravity, offset and columns of friction at rest, for all joints at once in N·m.

    Attributes:
        load_gravity_: (p,) gravity parameters that the loads in the columns are computed with.
        load_limit_: (n,) largest torque in the columns [N·m], see `FARTHEST_LOAD`.
        celsius_: (n,) mean temperatures in training; NaN where nobody measured them, or they
            hardly changed.
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
        """Columns (D, n) of friction by name, the same names always."""

    def _drive_terms(self, q: FloatArray, load: FloatArray) -> dict[str, FloatArray]:
        """Columns (N, n) by name of what drives do at positions q and loads, both (N, n)."""
        return {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: two dwells for each of a joint's own terms.

        Each pose gives a row to every joint, and every joint has terms of its own.
        """
        still = np.zeros((1, 1))
        unmoved = Rest(still, still, np.zeros((1, SMOOTHED, 2, 1)), still)
        terms = {"offset", *self._drive_terms(still, still), *self._terms(unmoved)}
        return Needs({"dwells": 2 * len(terms)}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the dwells of the data.

        Dwells of which it is not known from where every joint came are left out, and `notes_` says
        how many.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, do not say from
                where the poses were approached, or do not excite all parameters.
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
        """Add to the fit what else there is to learn from dwells with one row each."""

    def predict(self, dataset: Dataset) -> Prediction:
        """Gravity, offset, drive, friction and payload per row.

        Friction is known for dwells whose approach is known; elsewhere it is 0, and the rows are
        marked as not valid.

        Raises:
            DataError: The data are of another robot or unit.
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
        """A predictor for one sample at a time, at the sample rate of the training data.

        It sees from the positions when the arm stops and how; in motion it knows gravity only.
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
        """(n,) level of dry friction of an unloaded joint [N·m]."""
        own = dict(zip(self.parameter_names_, self.coefficients_.tolist(), strict=True))
        return np.array(
            [abs(sum(own.get(f"{j}.{t}", 0.0) for t in self._dry())) for j in self.joint_names_]
        )

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """As of every linear model, and what the columns need."""
        return super().fitted_arrays() | {
            "load_gravity": self.load_gravity_,
            "load_limit": self.load_limit_,
            "celsius": self.celsius_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """As of every linear model; the sample time, and the terms there might have been."""
        own = {"period_s": self.period_, "terms": list(self._names)}
        return super().fitted_facts() | own

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
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
        """Terms that add up to the dry friction of an unloaded joint."""
        return ("coulomb",)

    def _approached(self, rows: Dataset) -> Dataset:
        """The dwells of which it is known from where every joint came."""
        paths = rows.arrivals if rows.arrivals is not None else unknown_paths(rows)
        if np.isinf(paths).any():
            raise FitError(
                "the paths into the dwells hold infinite values",
                hint="load the recording again: positions and velocities must be finite",
            )
        known = approach_directions(paths) != 0
        if not known.any():
            raise FitError(
                f"{self.estimator} needs to know from where the poses were approached, and the "
                "data do not hold the motion before the dwells",
                hint="record the moves as well (hil run does), or fit static-wls",
            )
        if not known.any(axis=0).all():
            names = [rows.joint_names[j] for j in np.flatnonzero(~known.any(axis=0))]
            raise FitError(
                f"{', '.join(names)} did not move before any of the dwells, so how friction holds "
                "it there is not known",
                hint="record a program in which every joint moves, or fit static-wls",
            )
        whole = known.all(axis=1)
        left_out = len(whole) - int(whole.sum())
        told = (
            f"{left_out} of {len(whole)} dwells are left out: from where some joint came there is "
            "not in the data"
        )
        self.notes_ = (told,) if left_out else ()
        return rows.take(np.flatnonzero(whole))

    def _choose_terms(self, rows: Dataset, only: Sequence[str] = ()) -> None:
        """Name the parameters: terms that say something which those before them do not.

        Joint 1 of an upright arm bears no load; where nothing slides back all states are the sign
        of the approach. The gain of the joint that bears most is left out: if all gains were wrong
        by one factor, the gravity parameters would be, and nobody could tell.
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
            told = independent(np.stack(list(own.values()), axis=1)).tolist()
            names += [f"{joint}.{term}" for term, new in zip(own, told, strict=True) if new]
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
        """(D, n) the columns times their coefficients, in effort units."""
        own = np.zeros(self._alive.shape)  # 0 for terms that a joint does not have
        own[self._alive] = self.coefficients_[len(self._form.names) :]
        total: FloatArray = sum(
            (values * own[:, self._names.index(term)] for term, values in columns.items()),
            start=np.zeros(()),
        )
        return total / self.torque_scale_

    def _load(self, data: Dataset) -> FloatArray:
        """(N, n) torque of gravity and payload [N·m], see `FARTHEST_LOAD`."""
        q, still = data["q"], np.zeros_like(data["q"])
        gravity = (self._form.columns(q) @ self.load_gravity_).reshape(q.shape)
        load = gravity + payload_torque(self.robot_, data, q, still, still)
        return np.where(
            np.abs(load) > NOTHING, np.clip(load, -self.load_limit_, self.load_limit_), 0.0
        )

    def rest(self, rows: Dataset) -> Rest:
        """What the columns are made of, for dwells with one row each."""
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
        """Friction, its standard deviation (both in effort units) and whether it is known."""
        rest = self.rest(rows)
        friction = self._weighted(self._terms(rest))
        return friction, np.broadcast_to(self.sigma_, friction.shape), rest.direction != 0


class StaticCoulomb(StaticFriction):
    """Gravity, offset and Coulomb friction with the sign of the approach, joint by joint."""

    estimator: ClassVar[str] = "static-coulomb"

    def _terms(self, rest: Rest) -> dict[str, FloatArray]:
        return {"coulomb": rest.direction}


LENGTHS_RAD = (0.7e-4, 1.4e-4, 2.8e-4, 5.6e-4)
"""From a third of what the finest encoders of arms resolve to what gears give way by."""


def _lengths(name: str, value: Any) -> tuple[float, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        raise SpecError(f"{name} is {value!r}, but must be a list of lengths")
    return tuple(number(name, length, above=0.0) for length in value)


_ARRAYS = ("mean", "scale", "weights", "leverage")


class StaticHysteresis(StaticFriction):
    """Gravity, offset, friction with memory, load and temperature, and a learnt correction.

    Attributes:
        penalty_: (n,) of the correction.
        sigma_: (n,) deviation on poses that the correction had not seen, in effort units.
    """

    estimator: ClassVar[str] = "static-hysteresis"

    lengths_rad: tuple[float, ...] = parameter(
        LENGTHS_RAD, _lengths, doc="Lengths of Dahl's states [rad]."
    )
    gear_ratio: float | None = parameter(
        None,
        number,
        above=0.0,
        optional=True,
        doc="Motor turns per joint turn, for the ripple of the gear at once and twice a motor "
        "turn; None leaves it out.",
    )
    correction: bool = parameter(
        True,
        flag,
        doc="Whether to try the columns on poses held out of the training, and correct by the "
        "paths what they leave there; False keeps the columns as they are.",
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
        """(D, n) effort less what a fit without the pose predicts for it.

        None when friction with memory does worse on poses it has not seen than one level of
        friction, or when there are too few poses to find out.
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
        """Be `static-coulomb`, and say so."""
        self._choose_terms(rows, only=FIRST_TERMS)
        self._solve(rows, weighted=True)
        told = (
            "friction with memory is left out: on poses held out of the training it predicted no "
            "better than one level of friction, or there are too few poses to tell"
        )
        self.notes_ = (*self.notes_, told)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """As of every linear model, and the corrections."""
        own = {
            f"correction_{name}": np.stack([getattr(one, name) for one in self._corrections])
            for name in (_ARRAYS if self._corrections else ())
        }
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """As of every linear model, and the penalties of the corrections."""
        penalties = [one.penalty for one in self._corrections]
        return super().fitted_facts() | {"correction_penalty": penalties}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
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
    """Arms at rest, one row each, and how they came there.

    Attributes:
        load: (D, n) torque that gravity and payload take [N·m], as far as it is known beforehand.
        direction: (D, n) +1 from below, −1 from above, 0 unknown.
        paths: (D, K, 2, n) see `hil.data.arrival`; 0 where unknown.
        warmer: (D, n) joint temperatures less their mean in training [K]; 0 where unknown.
    """

    load: FloatArray
    direction: FloatArray
    paths: FloatArray
    warmer: FloatArray


GAIN = "gain"


def drive_terms(q: FloatArray, load: FloatArray, gear_ratio: float | None) -> dict[str, FloatArray]:
    """Columns (N, n) by name of what the drives do to the current, friction or not.

    Args:
        q: (N, n) where [rad].
        load: (N, n) torque borne [N·m].
        gear_ratio: Motor turns per joint turn, for the ripple of the gear; None for no ripple.

    Returns:
        `gain` (τ: the error of a joint's drive gain beside the other joints'), `square` (τ·|τ|:
        eq. 16 solved for the current, to first order), `ripple…`.
    """
    terms = {GAIN: load, "square": load * np.abs(load)}
    for turns in (1, 2) if gear_ratio is not None else ():
        phase = turns * (gear_ratio or 0.0) * q
        terms |= {f"ripple{turns}_sin": np.sin(phase), f"ripple{turns}_cos": np.cos(phase)}
    return terms


def memory_terms(rest: Rest, lengths_rad: Sequence[float]) -> dict[str, FloatArray]:
    """Columns (D, n) by name: `coulomb` and `memory1…`, and how they go with load and temperature.

    Args:
        rest: What is known of the arms.
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
    """(n, D, F) inputs of the linear correction of each joint.

    Its own path, position and velocity point by point, the position also times its load; and of
    all joints the load, the load with the joint's own direction, the load with its magnitude, and
    the temperature with its own direction: what stopping one joint does to the others.
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
"""Points of a path that a local parabola is fitted to: the encoder's noise is a tenth of what the
slide back is, and Dahl's states would take every noisy step for a small motion."""


def smooth(paths: FloatArray) -> FloatArray:
    """(D, K, n) paths as local parabolas have them."""
    smoothed: FloatArray = savgol_filter(paths, SMOOTHED, 2, axis=1)
    return smoothed


def celsius(rows: Dataset) -> FloatArray:
    """(D, n) joint temperatures, NaN where nobody measured them."""
    return rows.columns.get("temperature", np.full_like(rows["q"], np.nan))


LEAST_SPAN_K = 1.0
"""Temperatures that change by less in training say nothing about how friction goes with them."""


def mean_celsius(rows: Dataset) -> FloatArray:
    """(n,) mean temperatures; NaN where unknown, or where they say nothing."""
    found = np.full(rows.n_joints, np.nan)
    for j, measured in enumerate(celsius(rows).T):
        known = measured[np.isfinite(measured)]
        if len(known) and np.ptp(known) >= LEAST_SPAN_K:
            found[j] = np.mean(known)
    return found


def period(t: FloatArray) -> float:
    """Usual time between samples at times t (N,) [s]; NaN when it never advances."""
    steps = np.diff(t)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else np.nan


def unknown_paths(rows: Dataset) -> FloatArray:
    """(S, K, 2, n) paths of which nothing is known."""
    return np.full((len(rows.conditions), ARRIVAL_POINTS, 2, rows.n_joints), np.nan)


def dwells_in(dataset: Dataset) -> tuple[Dataset, BoolArray, IntArray]:
    """The dwells that have rows, which rows (N,) are theirs, and the dwell of each of those."""
    there = np.diff(dataset.offsets) > 0
    at_rest = np.array([c.kind in AT_REST for c in dataset.conditions], dtype=bool)
    chosen = at_rest & there
    series = dataset.series_index()
    at = chosen[series]
    return dataset.take(np.flatnonzero(chosen)), at, (np.cumsum(chosen) - 1)[series[at]]


LEAST_OWN = 1e-4
"""Share of a column that no others account for, below which it is left out."""


def independent(columns: FloatArray) -> BoolArray:
    """(k,) which of the columns (D, k) are no combination of those kept before them."""
    basis = np.empty((len(columns), 0))
    kept = []
    for column in columns.T:
        left = column
        for _ in range(2):  # once is not enough for columns that are nearly a combination
            left = left - basis @ (basis.T @ left)
        size, own = float(np.linalg.norm(column)), float(np.linalg.norm(left))
        kept.append(own > LEAST_OWN * size)
        if kept[-1]:
            basis = np.column_stack([basis, left / own])
    return np.array(kept, dtype=bool)
