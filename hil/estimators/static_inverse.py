"""Eq. 16–19 of the static paper without the current among the inputs: fit τ(i), then invert it.

Eq. 19 divides eq. 18 by K₁ and moves i²·sign(i) to the side of the regressors, where it stands for
the current that is to be predicted. Here gravity comes from the positions alone and the drive's
curve is inverted (`hil.estimators.drive_curve`): i = f⁻¹(φ(q)·θ; K₁, K₂, K₀).

The measured current is full of friction that has nothing to do with the pose. Whoever regresses
gravity on i and i² has that friction in the regressor, which pulls K₁ and K₂ off (errors in
variables), and cannot tell gravity and K₁ apart: only θ/K₁ shows. So the error of the *predicted
current* is minimised over θ, K₂ and K₀ (`hil.estimators.drive_curve`), with K₁ given: the drive
gains, or 1 where nobody knows them, θ then being in amperes. The regressor holds only positions,
which are exact. A gravity model that lacks a term leaves its error in K₂.

K₂ shows as curvature of i over gravity and is small. Where the data do not tell it from 0 it is
left out (`square: auto`), and the model says so, joint by joint (`joint_notes_`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray, IntArray
from hil.data import Dataset, Prediction
from hil.dynamics import RobotModel
from hil.estimators.base import payload_torque
from hil.estimators.checks import Needs, require_rank
from hil.estimators.covariance import interval
from hil.estimators.drive_curve import (
    CurrentFit,
    Currents,
    fit_currents,
    has_current,
    linear_residual,
    nearest_current,
    visible_squares,
)
from hil.estimators.parameters import choice, parameter
from hil.estimators.static_model import Form, PoseClustered, deviation, one_row_each, pose_numbers

Square = Literal["auto", "free", "zero"]

SURE = 0.99
"""Level of the interval of K₂ that must leave out 0 with `square: auto`."""

NO_COLUMN = 1e-9
"""Regressors of gravity, about 1 to 10 in SI, below this are rounding errors."""

NO_GRAVITY = "no gravity acts on it in this model, so its current at rest is predicted as constant"
LINEAR = "the data do not tell K₂ from 0: torque goes linearly with current"
ASSUMED = "K₂ is taken as 0: torque goes linearly with current"


class StaticInverse(PoseClustered):
    """Gravity, and a drive whose torque bends with its current; predicts by inverting eq. 16.

    Attributes:
        parameter_names_: Gravity parameters, then per joint `square` (K₂, 0 with NaN as its error
            where it was left out) and `offset` (−K₀).
        joint_notes_: What there is to know of each joint, in words; empty for most.
    """

    estimator: ClassVar[str] = "static-inverse"
    current_term = False

    form: Form = parameter(
        "paper",
        choice,
        ("paper", "shared"),
        doc="`paper`, each joint by itself with φ₂…φ₅ of eq. 15, or `shared`, all joints at once "
        "(drive gains needed).",
    )
    square: Square = parameter(
        "auto",
        choice,
        ("auto", "free", "zero"),
        doc="Whether K₂ is estimated: `auto` keeps it where its 99 % interval leaves out 0, `free` "
        "wherever it could show, `zero` nowhere.",
    )

    joint_notes_: tuple[str, ...]

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: poses as `PoseClustered`, and motor currents.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        return replace(super().needs(robot, loaded=loaded), effort="current")

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the mean currents of dwells, or of the stays found in motions without a plan.

        Raises:
            FitError: The efforts are no currents; there are too few poses, a joint that has to
                move did not, a parameter is not determined, or data are not finite or of another
                robot or unit.
        """
        dwells = self._enough_dwells(dataset, robot)
        data = one_row_each(dwells)
        gravity = self._form.columns(data["q"]).reshape(len(data), data.n_joints, -1)
        self._require_excited(data, gravity)
        self._allocate()
        notes = dict.fromkeys(range(data.n_joints), "")
        for joints in self._joint_groups():
            notes |= self._fit_joints(data, gravity, joints, pose_numbers(dwells))
        self.std_error_ = np.sqrt(np.diag(self.covariance_))
        self.joint_notes_ = tuple(notes.values())
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """The current that holds gravity and load; from positions, no current is looked at.

        Not valid where the arm moves, nor where no current makes the torque by eq. 16; there the
        current at the drive's turning point is told.

        Raises:
            DataError: The data are of another robot or unit.
            FitError: A load is mounted, and the fit knew no drive gains.
        """
        return super().predict(dataset)

    @property
    def constants_(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """K₁ [N·m/A], K₂ [N·m/A²] and K₀ [N·m] of eq. 16, (n,) each; K₁ as given to the fit."""
        own = self._own_coefficients()
        return self.torque_scale_, own[:, 0], -own[:, 1]

    def fitted_facts(self) -> dict[str, Any]:
        """As of every static model, and what there is to know of each joint."""
        words = dict(zip(self.joint_names_, self.joint_notes_, strict=True))
        return super().fitted_facts() | {"joints": words}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.joint_notes_ = tuple(str(facts["joints"][name]) for name in self.joint_names_)

    def _require_effort(self, dataset: Dataset, needed: str) -> None:
        if dataset.effort_kind != needed:
            raise FitError(
                f"static-inverse needs motor currents, but the data hold a {dataset.effort_kind}",
                hint="use static-linear or static-wls for torques",
            )

    def _own_terms(self) -> tuple[str, ...]:
        return ("square", "offset")

    def _fit_joints(
        self, data: Dataset, gravity: FloatArray, joints: IntArray, pose: IntArray
    ) -> dict[int, str]:
        """Fit joints that share parameters; what is to be said of each."""
        pulled = [int(j) for j in joints if np.max(np.abs(gravity[:, j])) > NO_COLUMN]
        linear = self._currents(data, gravity, joints, pose)
        # As in static-wls: quiet joints count more, by the residual of a linear fit.
        rough = linear_residual(linear).reshape(-1, len(joints))
        sigma = np.maximum(deviation(rough, linear.X.shape[1]), 1e-12)
        rows = Currents(
            linear.X, linear.load, linear.current, linear.k1, linear.joint, linear.pose,
            np.tile(1.0 / sigma**2, len(data)),
        )  # fmt: skip
        squares = [] if self.square == "zero" else visible_squares(rows, pulled)
        found = fit_currents(rows, squares)
        if self.square == "auto" and squares:
            squares = _significant(found, squares)
            found = fit_currents(rows, squares)
        self._keep(found, joints, squares)
        left_out = ASSUMED if self.square == "zero" else LINEAR
        notes = {j: "" if j in squares else left_out for j in pulled}
        return {int(j): notes.get(int(j), NO_GRAVITY) for j in joints}

    def _currents(
        self, data: Dataset, gravity: FloatArray, joints: IntArray, pose: IntArray
    ) -> Currents:
        """Rows of the joints, sample by sample, weighted alike."""
        still, n = np.zeros_like(data["q"]), len(joints)
        load = payload_torque(self.robot_, data, data["q"], still, still)
        columns = self._gravity_of(joints)
        shared = gravity[:, joints][:, :, columns].reshape(len(data) * n, len(columns))
        offset = np.tile(np.eye(n), (len(data), 1))
        return Currents(
            X=np.hstack([shared, offset]),
            load=load[:, joints].ravel(),
            current=data["effort"][:, joints].ravel(),
            k1=np.tile(self.torque_scale_[joints], len(data)),
            joint=np.tile(joints, len(data)),
            pose=np.repeat(pose, n),
            weight=np.ones(len(data) * n),
        )

    def _keep(self, found: CurrentFit, joints: IntArray, squares: list[int]) -> None:
        """Put what was found among all parameters."""
        offsets = [self._offset_of(int(j)) for j in joints]
        at = [*self._gravity_of(joints), *offsets, *(self._offset_of(j) - 1 for j in squares)]
        require_rank(
            found.rank, found.condition, [self.parameter_names_[k] for k in at], found.jacobian
        )
        self.coefficients_[at] = [*found.coefficients, *found.squares]
        self.covariance_[np.ix_(at, at)] = found.clustered.covariance
        self.degrees_[at] = found.clustered.degrees
        self.condition_ = max(self.condition_, found.condition)
        left_out = [self._offset_of(int(j)) - 1 for j in joints if j not in squares]
        self.covariance_[left_out, left_out] = np.nan
        residual = found.residual.reshape(-1, len(joints))
        self.sigma_[joints] = deviation(residual, len(at))

    def _gravity_of(self, joints: IntArray) -> list[int]:
        return [k for k, j in enumerate(self._form.joint) if j is None or j in joints]

    def _gravity_torque(self, q: FloatArray) -> FloatArray:
        """(N, n) gravity [N·m]."""
        gravity = self.coefficients_[: len(self._form.names)]
        torque: FloatArray = (self._form.columns(q) @ gravity).reshape(q.shape)
        return torque

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        alone = nearest_current(np.zeros_like(q), *self.constants_)
        held = nearest_current(self._gravity_torque(q), *self.constants_)
        return {"gravity": held - alone, "offset": alone}

    def _predict(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> Prediction:
        parts = self._all_parts(dataset, q, qd, qdd)
        load = payload_torque(self.robot_, dataset, q, qd, qdd)
        torque = self._gravity_torque(q) + load
        effort = nearest_current(torque, *self.constants_)
        valid = np.isfinite(effort) & has_current(torque, *self.constants_)
        parts["payload"] = effort - sum(parts.values())
        return Prediction(effort, np.broadcast_to(self.sigma_, effort.shape), valid, parts)

    def _load_effort(
        self, load: Payload, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        gravity = self._gravity_torque(q)
        loaded = gravity + self.robot_.payload_effort(load, q, qd, qdd)
        with_load, without = (nearest_current(t, *self.constants_) for t in (loaded, gravity))
        return with_load - without


def _significant(found: CurrentFit, squares: list[int]) -> list[int]:
    """The joints whose K₂ the data tell from 0."""
    last = slice(len(found.coefficients), None)
    error = np.sqrt(np.diag(found.clustered.covariance)[last])
    ends = interval(found.squares, error, found.clustered.degrees[last], SURE)
    return [joint for joint, (low, high) in zip(squares, ends, strict=True) if low * high > 0]
