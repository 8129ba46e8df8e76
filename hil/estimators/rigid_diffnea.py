"""Newton–Euler identification in coordinates in which every point is an arm that can exist.

τ = Y_b(q, q̇, q̈)·B·φ(θ) + friction, with θ the log-Cholesky coordinates of every link's
pseudo-inertia (Rucker & Wensing 2022), rotor inertias and friction coefficients kept from being
negative by their coordinates too, and the friction's shapes fitted along. The regressor is computed
once and compressed to one triangle, so that Levenberg–Marquardt with exact derivatives needs well
under a millisecond per step. What the data do not determine stays near the nominal arm by a weak
Bregman divergence (Lee, Wensing & Park 2020): no link ever weighs tons.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import Dataset, FilterSettings, Stream
from hil.estimators.checks import require_sizes
from hil.estimators.diffnea.arm import DiffneaArm
from hil.estimators.diffnea.bodies import MASS_FACTOR, Bodies
from hil.estimators.diffnea.fit import DiffneaFit
from hil.estimators.diffnea.forms import FORMS
from hil.estimators.diffnea.unknowns import Unknowns, folding
from hil.estimators.friction_curve import FrictionCurve, curve_of
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares
from hil.estimators.parameters import choice, number
from hil.estimators.rigid_linear import RigidLinear
from hil.estimators.streaming import DahlMemory, SampleStream

WELL_CONDITIONED = 1e7
"""Condition number of the column-scaled regressor up to which data determine all parameters."""


class RigidDiffnea(RigidLinear):
    """Physically consistent rigid-body dynamics and friction by Gauss–Newton.

    Args:
        friction: `coulomb-viscous`, `stribeck`, `stribeck-power` or `memory`, see
            `hil.estimators.diffnea.forms`.
        prior: Pull towards the nominal arm: how many samples one unit of Bregman divergence
            counts for.
        mass_factor: Links weigh at most this many times what the robot model says (small ones: a
            tenth of the arm); above 1.
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.

    Attributes:
        inertial_: (11n,) in the order of `RobotModel.parameters(rotor=True)`; always of bodies that
            can exist.
        parameter_names_: Base parameters, friction coefficients joint by joint, then shapes.
        gear_rigid_: (b,) base parameters the torque through the gears was computed with.
        coefficients_: Their values, `std_error_` by the delta method.
    """

    estimator: ClassVar[str] = "rigid-diffnea"

    inertial_: FloatArray
    gear_rigid_: FloatArray

    def __init__(
        self,
        *,
        friction: str = "stribeck",
        prior: float = 1.0,
        mass_factor: float = MASS_FACTOR,
        sign_width: float = 0.01,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sign_width=sign_width, filters=filters)
        self.friction = choice("friction", friction, tuple(FORMS))
        self.prior = number("prior", prior, above=0.0)
        self.mass_factor = number("mass_factor", mass_factor, above=1.0)

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time that carries friction states, if there are any."""
        arm, values, mounted = self._arm, self.coefficients_, payload or Payload()
        if not arm.form.multiples:
            return super().stream(payload)

        def effort(
            q: FloatArray, qd: FloatArray, qdd: FloatArray, states: Mapping[float, FloatArray]
        ) -> FloatArray:
            load = np.zeros_like(q)
            if not mounted.is_empty:
                load = self.robot_.payload_effort(mounted, q, qd, qdd)
            transmitted = arm.rigid(self.gear_rigid_, q, qd, qdd) + load
            friction = arm.friction(arm.moment(qd, transmitted, states), values)
            return (arm.rigid(values, q, qd, qdd) + friction + load) / self.torque_scale_

        length = arm.friction_values(values)[1][:, 0]
        return SampleStream(self.robot_.n, DahlMemory(length, arm.form.multiples), effort)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Friction at velocities (N, n) [rad/s]; None of a form that has memory."""
        form = self._arm.form
        if form.multiples:
            return None
        values, shapes = self._arm.friction_values(self.coefficients_)
        errors, of_shapes = self._arm.friction_values(self.std_error_)
        columns, slope = form.evaluate(self._arm.moment(qd), shapes)
        curve = curve_of(form.terms, columns, values, errors)
        bent = np.abs(np.einsum("Njks,jk->Njs", slope, values)) * of_shapes
        return replace(curve, std_error=curve.std_error + bent.sum(axis=-1))

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of every linear model, and the full inertial parameters."""
        own = {"inertial": self.inertial_, "gear_rigid": self.gear_rigid_}
        return super().fitted_arrays() | own

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.inertial_, self.gear_rigid_ = arrays["inertial"], arrays["gear_rigid"]
        require_sizes(self, gear_rigid=self._base.rank, inertial=11 * self.robot_.n)

    def _joint_terms(self) -> tuple[str, ...]:
        form = FORMS[self.friction]
        return (*form.terms, *(shape.name for shape in form.shapes))

    def _open(self) -> None:
        super()._open()
        form, joints = FORMS[self.friction], self.joint_names_
        self._arm = DiffneaArm(self.robot_, self._base, form, self.sign_width)
        terms = (f"{joint}.{term}" for joint in joints for term in form.terms)
        shapes = (f"{joint}.{shape.name}" for joint in joints for shape in form.shapes)
        self.parameter_names_ = (*self._base.names, *terms, *shapes)

    def _learn(self, data: Dataset) -> None:
        """Shapes where they start, then fitted to rows of bounded number, then all rows."""
        scale = np.ones((data.n_joints, len(self._arm.form.terms)))
        bodies, fold = Bodies.nominal(self.robot_, self.mass_factor), folding(self._base)
        unknowns = Unknowns(bodies, fold, self._arm.form, scale)
        self._start_from(unknowns.at(unknowns.start())[0])
        observed = self._compressed(data)
        fit = DiffneaFit.begun(unknowns, observed, self.prior)
        if self._arm.form.shapes:
            self._start_from(fit.values)
            fit = fit.bent(self._arm.bending_rows(data, self._target(data), self.gear_rigid_))
            self._start_from(fit.values)
            observed = self._compressed(data)
            fit = fit.finished(observed)
        self.inertial_ = fit.inertial
        self.notes_ = fit.notes(self.joint_names_)
        self._adopt(data, fit.solution(observed))

    def _start_from(self, values: FloatArray) -> None:
        """Evaluate columns at these values from now on."""
        self.coefficients_, self.gear_rigid_ = values, values[: self._base.rank]

    def _estimate(self, observed: JointwiseQR) -> Solution:
        """What the same columns give without any constraint, for comparison."""
        return jointwise_least_squares(observed, weighted=True)

    def _adopt(self, data: Dataset, found: Solution) -> None:
        self.coefficients_, self.condition_ = found.coefficients, found.condition
        self.sigma_ = found.sigma / self.torque_scale_
        if found.condition > WELL_CONDITIONED:
            self.notes_ += (
                f"the data determine only {found.rank} directions of the parameters (condition "
                f"number {found.condition:.2g}); along the others they are the nominal arm's",
            )
        self._set_uncertainty(data, found)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        # The columns of shapes tell how the residual bends, not what it is.
        straight = np.array(coefficients)
        straight[len(straight) - len(self._arm.form.shapes) * data.n_joints :] = 0.0
        return super()._residual(data, straight)

    def _target(self, data: Dataset) -> FloatArray:
        return data["effort_f"] * self.torque_scale_ - self._arm.load(data)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        target = self._target(data)
        return self._arm.observations(data, target, self.coefficients_, self.gear_rigid_)

    def _all_parts(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        motion = self._arm.motion(dataset, self.gear_rigid_)
        friction = self._arm.friction(motion, self.coefficients_)
        parts = super()._all_parts(dataset, q, qd, qdd)
        return {**parts, "friction": friction / self.torque_scale_}

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        values, still = self.coefficients_, np.zeros_like(q)
        gravity = self._arm.rigid(values, q, still, still)
        parts = {"gravity": gravity, "inertia": self._arm.rigid(values, q, qd, qdd) - gravity}
        if not self._arm.form.multiples:
            parts["friction"] = self._arm.friction(self._arm.moment(qd), values)
        return {name: part / self.torque_scale_ for name, part in parts.items()}
