"""What models share that know how an arm came to rest: gravity, an offset, and friction columns."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray
from hil.data import Dataset, Prediction, SeriesKind, Stream, directions
from hil.dynamics import RobotModel, joint_columns
from hil.estimators.base import payload_torque
from hil.estimators.checks import Needs
from hil.estimators.rest_friction import GAIN, SMOOTHED, Rest
from hil.estimators.rest_rows import (
    celsius,
    dwells_in,
    independent,
    mean_celsius,
    period,
    resting,
    unknown_paths,
)
from hil.estimators.standstill import resting_at
from hil.estimators.static_model import StaticModel
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
        rows = self._approached(resting(self._dwells(dataset, robot)))
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
            friction, deviation, known = self._friction(resting(dwells))
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
        known = directions(paths) != 0
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
        return Rest(self._load(rows), directions(paths), np.nan_to_num(paths), warmer)

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
