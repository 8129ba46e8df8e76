"""Eq. 16–19 of the static paper without the current as an input: fit τ(i) and invert it.

Eq. 19 divides eq. 18 by K₁ and uses i²·sign(i) as a regressor, although the current is the quantity
to be predicted. In this module, gravity is computed from the positions alone, and the curve of the
drive is inverted (`hil.estimators.drive_curve`): i = f⁻¹(φ(q)·θ; K₁, K₂, K₀).

The measured current contains friction that does not depend on the pose. A regression of gravity on
i and i² has this friction in its regressor. This pose-independent friction biases K₁ and K₂ (errors
in variables), and the regression cannot separate gravity from K₁: only θ/K₁ is identifiable. In
this module, the error of the *predicted current* is minimised over θ, K₂ and K₀
(`hil.estimators.drive_curve`) for a given K₁. K₁ is the drive gain, or 1 if the gain is unknown; θ
is then in amperes. The regressor of this fit contains only positions, which are exact. If the
gravity model lacks a term, K₂ contains the resulting error.

K₂ is a small curvature of the current over gravity. If the data do not determine K₂ significantly,
K₂ is set to 0 (`square: auto`), and a note for the joint reports the missing K₂ (`joint_notes_`).
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
"""Confidence level of the K₂ interval that must exclude 0 if `square: auto` is set."""

NO_COLUMN = 1e-9
"""Magnitude below which a gravity regressor, usually 1 to 10 in SI units, is a rounding error."""

NO_GRAVITY = "no gravity acts on this joint in the model, so its static current is constant"
LINEAR = "the data do not distinguish K₂ from 0: torque is linear in current"
ASSUMED = "K₂ is set to 0: torque is linear in current"


class StaticInverse(PoseClustered):
    """Gravity and nonlinear drive curve of a static arm; the prediction inverts eq. 16.

    Attributes:
        parameter_names_: Gravity parameters, followed by `square` (K₂) and `offset` (−K₀) of each
            joint. If K₂ was left out, the value of `square` is 0 and its standard error is NaN.
        joint_notes_: One note per joint for the user; the note is empty for most joints.
    """

    estimator: ClassVar[str] = "static-inverse"
    current_term = False

    form: Form = parameter(
        "paper",
        choice,
        ("paper", "shared"),
        doc="`paper`: each joint separately, with φ₂…φ₅ of eq. 15; `shared`: all joints together "
        "(drive gains needed).",
    )
    square: Square = parameter(
        "auto",
        choice,
        ("auto", "free", "zero"),
        doc="Estimation of K₂: `auto` keeps K₂ only if its 99 % interval excludes 0, `free` keeps "
        "K₂ whenever it is observable, `zero` sets K₂ to 0.",
    )

    joint_notes_: tuple[str, ...]

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: number of poses, and motor currents.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        return replace(super().needs(robot, loaded=loaded), effort="current")

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to the mean currents of the dwells.

        Dwells are detected if the recording has no plan.

        Raises:
            FitError: The efforts are torques, there are too few poses, a joint that must move did
                not move, a parameter is not determined, or the data are not finite or are of a
                different robot or unit.
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
        """Return the current that holds gravity and payload, from positions alone.

        The prediction is not valid in motion, or if no current produces the torque by eq. 16. If no
        current produces the torque, the prediction is the current at the turning point of the drive
        curve.

        Raises:
            DataError: Robot or unit of the data differ from those of the model.
            FitError: A payload is mounted, and the training data had no drive gains.
        """
        return super().predict(dataset)

    @property
    def constants_(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Constants K₁ [N·m/A], K₂ [N·m/A²] and K₀ [N·m] of eq. 16, (n,) each; K₁ is not fitted."""
        own = self._own_coefficients()
        return self.torque_scale_, own[:, 0], -own[:, 1]

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a static model, and the note on each joint."""
        words = dict(zip(self.joint_names_, self.joint_notes_, strict=True))
        return super().fitted_facts() | {"joints": words}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.joint_notes_ = tuple(str(facts["joints"][name]) for name in self.joint_names_)

    def _require_effort(self, dataset: Dataset, needed: str) -> None:
        if dataset.effort_kind != needed:
            raise FitError(
                "static-inverse needs motor currents, but the data contain a "
                f"{dataset.effort_kind}",
                hint="use static-linear or static-wls for torques",
            )

    def _own_terms(self) -> tuple[str, ...]:
        return ("square", "offset")

    def _fit_joints(
        self, data: Dataset, gravity: FloatArray, joints: IntArray, pose: IntArray
    ) -> dict[int, str]:
        """Fit the joints that share parameters, and return a note on each joint."""
        pulled = [int(j) for j in joints if np.max(np.abs(gravity[:, j])) > NO_COLUMN]
        linear = self._currents(data, gravity, joints, pose)
        # As in static-wls, joints are weighted by the residual of a linear fit.
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
        """Return the rows of the passed joints, sample by sample, with equal weights."""
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
        """Store the fitted values of some joints in the arrays of all parameters."""
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
        """Return (N, n) the predicted gravity torque [N·m]."""
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
    """Return the joints whose K₂ differs significantly from 0."""
    last = slice(len(found.coefficients), None)
    error = np.sqrt(np.diag(found.clustered.covariance)[last])
    ends = interval(found.squares, error, found.clustered.degrees[last], SURE)
    return [joint for joint, (low, high) in zip(squares, ends, strict=True) if low * high > 0]
