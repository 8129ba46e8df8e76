"""The base of all linear models of an arm at rest: regressor (eq. 18–20), predictions, refusals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray, SpecError
from hil.data import Dataset, DwellRule, Prediction, SeriesKind, Stream, dwells_of
from hil.dynamics import RobotModel, joint_columns
from hil.estimators.base import HONEST, WlsEstimator, load_of, payload_torque
from hil.estimators.checks import (
    Needs,
    require_clean,
    require_plausible,
    require_robot,
    torque_scale,
)
from hil.estimators.gravity import BaseGravity, GravityForm, PaperGravity

Form = Literal["shared", "paper"]

PAPER_PROTOCOL = "paper: the measured current is among the inputs"
CURRENT_PART = "measured current² (paper protocol)"
"""Component of a prediction that is made of what is to be predicted."""


class StaticModel(WlsEstimator):
    """Gravity and offset of an arm at rest, linear in the parameters.

    At rest, gravity is the motor's torque, φ_j·θ_j = K₂·i²·sign(i) + K₁·i + K₀ (eq. 18, static
    paper). Divided by K₁ (eq. 19) it is linear: with `current_term` joint j's regressor is
    R_j = [φ_j, i²·sign(i), 1] (eq. 20), and its last two coefficients are −K₂/K₁ and −K₀/K₁ after
    division by `torque_scale_[j]`.

    Attributes:
        form, current_term, rest_speed: Parameters that every subclass has.
        parameter_names_: Gravity parameters, then per joint `offset`, or `current_squared` and
            `offset`.
        samples_: Number of dwells.
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",), ("trajectory",))
    tells_friction: ClassVar[bool] = False

    form: Form
    current_term: bool
    rest_speed: float

    @property
    def protocol(self) -> str:
        """`honest`, or with `current_term` that the target is among the inputs."""
        return PAPER_PROTOCOL if self.current_term else HONEST

    @property
    def knows_gains(self) -> bool:
        """Whether torques are in N·m: gains of 1 that come from nowhere stand for none."""
        without = not self.gains_source_ and bool(np.all(self.torque_scale_ == 1.0))
        return self.effort_kind_ == "torque" or not without

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: as many dwells as parameters.

        Currents need no gains when every joint is on its own and nothing is mounted.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        return Needs(
            {"dwells": len(self._form_of(robot).names) + robot.n * len(self._own_terms())},
            gains=loaded or self.form != "paper",
            effort="current" if self.current_term else "",
        )

    def _dwells(self, dataset: Dataset, robot: RobotModel) -> Dataset:
        """The dwells to fit to, or the stays found in motions without a plan; sets the regressor.

        Raises:
            FitError: The data are not finite, of another robot or unit, or hold efforts that
                cannot be; or `current_term` meets efforts that are no currents.
        """
        require_robot(dataset, robot)
        loaded = any(not load_of(condition).is_empty for condition in dataset.conditions)
        needs = self.needs(robot, loaded=loaded)
        self._require_effort(dataset, needs.effort)
        known = needs.gains or dataset.drive_gains is not None
        scale = torque_scale(dataset) if known else np.ones(dataset.n_joints)
        self._remember(dataset, robot, scale)
        require_clean(dataset, ("t", "q", "effort"))
        self._open()
        dwells = dwells_of(dataset, DwellRule(speed=self.rest_speed / 2))
        require_plausible(dwells, robot)
        return dwells

    def predict(self, dataset: Dataset) -> Prediction:
        """Gravity, offset and payload per row, from the measured positions.

        Rows in motion are predicted too, but marked as not valid. With `current_term` the
        *measured* effort of the dataset is an input as well: such numbers reproduce the paper
        and say nothing about how well a current can be predicted.

        Raises:
            DataError: The data are of another robot or unit.
            FitError: A load is mounted, and the fit knew no drive gains.
        """
        self.require_match(dataset)
        self._require_gains(any(not load_of(c).is_empty for c in dataset.conditions))
        still = np.zeros_like(dataset["q"])
        whole = self._predict(dataset, dataset["q"], still, still)
        parts, effort = dict(whole.components), whole.effort
        if self.current_term:
            parts[CURRENT_PART] = self._current_part(dataset["effort"])
            effort = effort + parts[CURRENT_PART]
        valid = whole.valid & np.isfinite(effort) & self._at_rest(dataset)[:, None]
        return Prediction(effort, whole.std, valid, parts)

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time.

        Raises:
            FitError: With `current_term`, for want of the current that is to be predicted; or a
                load is mounted, and the fit knew no drive gains.
        """
        if self.current_term:
            raise FitError(
                "a model with current_term cannot be streamed: it needs the measured current to "
                f"predict the current ({self.protocol})",
                hint="fit without current_term",
            )
        self._require_gains(payload is not None and not payload.is_empty)
        return super().stream(payload)

    def _require_form(self) -> None:
        if self.current_term and self.form != "paper":
            raise SpecError(
                "current_term is eq. 20 of the paper and goes with form: paper only",
                hint="add form: paper, or leave current_term out",
            )

    def _require_effort(self, dataset: Dataset, needed: str) -> None:
        if needed and dataset.effort_kind != needed:
            raise FitError(
                f"current_term needs motor currents, the data hold a {dataset.effort_kind}",
                hint="fit without current_term, or on a recording of currents",
            )

    def _require_gains(self, loaded: bool) -> None:
        """A load adds a torque; without gains nobody knows how much current that is."""
        if loaded and not self.knows_gains:
            raise FitError(
                "a load is mounted, but the model was fitted to currents without drive gains",
                hint="fit again on data that say their drive gains",
            )

    def _open(self) -> None:
        self._form = self._form_of(self.robot_)
        own = (f"{joint}.{term}" for joint in self.joint_names_ for term in self._own_terms())
        self.parameter_names_ = (*self._form.names, *own)

    def _form_of(self, robot: RobotModel) -> GravityForm:
        return PaperGravity(robot) if self.form == "paper" else BaseGravity(robot)

    def _own_terms(self) -> tuple[str, ...]:
        """What every joint has for itself beside gravity, the offset last."""
        return ("current_squared", "offset") if self.current_term else ("offset",)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        q, still = data["q"], np.zeros_like(data["q"])
        load = payload_torque(self.robot_, data, q, still, still)
        own = {"current": signed_square(data["effort"])} if self.current_term else {}
        columns = joint_columns(own | {"offset": np.ones_like(q)})
        W = np.hstack([self._form.columns(q), columns])
        yield slice(0, len(data)), W, data["effort"] * self.torque_scale_ - load

    def _own_coefficients(self) -> FloatArray:
        """(n, k) of the k terms that every joint has for itself, the offset last."""
        own: FloatArray = self.coefficients_[len(self._form.names) :]
        return own.reshape(len(self.joint_names_), -1)

    def _current_part(self, current: FloatArray) -> FloatArray:
        part: FloatArray = signed_square(current) * self._own_coefficients()[:, 0]
        return part / self.torque_scale_

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        gravity, offset = (
            self.coefficients_[: len(self._form.names)],
            self._own_coefficients()[:, -1],
        )
        torque = (self._form.columns(q) @ gravity).reshape(q.shape)
        return {
            "gravity": torque / self.torque_scale_,
            "offset": np.broadcast_to(offset / self.torque_scale_, q.shape),
        }

    def _at_rest(self, dataset: Dataset) -> BoolArray:
        """(N,) rows of dwells, and rows of motions in which every joint is slow enough."""
        kinds = np.array([c.kind in ("dwell", "reference") for c in dataset.conditions], dtype=bool)
        resting: BoolArray = kinds[dataset.series_index()]
        if "qd" in dataset.columns:
            resting = resting | (np.max(np.abs(dataset["qd"]), axis=1) < self.rest_speed)
        return resting


def signed_square(current: FloatArray) -> FloatArray:
    """i²·sign(i) of eq. 16, elementwise."""
    squared: FloatArray = current * np.abs(current)
    return squared
