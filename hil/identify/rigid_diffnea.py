"""Newton–Euler identification in coordinates in which every point is an arm that can exist.

τ = Y_b(q, q̇, q̈)·B·φ(θ) + friction, with θ the log-Cholesky coordinates of every link's
pseudo-inertia (Rucker & Wensing 2022), rotor inertias and friction coefficients kept from being
negative by their coordinates too, and the friction's shapes fitted along. The regressor is computed
once and compressed to one triangle, so that Levenberg–Marquardt with exact derivatives needs well
under a millisecond per step. What the data do not determine stays near the nominal arm by a weak
Bregman divergence (Lee, Wensing & Park 2020): no link ever weighs tons.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from hil.data.dataset import Dataset
from hil.data.filters import FilterSettings
from hil.identify.base import chunks, payload_torque
from hil.identify.compress import JointwiseQR
from hil.identify.diffnea.bodies import Bodies
from hil.identify.diffnea.fit import DiffneaFit
from hil.identify.diffnea.forms import FORMS, sign_of, spread
from hil.identify.diffnea.rows import BendingRows
from hil.identify.diffnea.unknowns import Unknowns, folding
from hil.identify.jointwise import Solution, jointwise_least_squares
from hil.identify.parameters import choice, number
from hil.identify.rigid_linear import MOTION, RigidLinear
from hil.typing import FloatArray

MOST_ROWS = 40_000
"""Rows that shapes are fitted to; of longer recordings, evenly chosen ones."""

WELL_CONDITIONED = 1e7
"""Condition number of the column-scaled regressor up to which data determine all parameters."""


class RigidDiffnea(RigidLinear):
    """Physically consistent rigid-body dynamics and friction by Gauss–Newton.

    Args:
        friction: `coulomb-viscous`, `stribeck` or `stribeck-power`, see
            `hil.identify.diffnea.forms`.
        prior: Weight of the pull towards the nominal arm: one unit of Bregman divergence counts as
            this share of all samples.
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.

    Attributes:
        inertial_: (11n,) in the order of `RobotModel.parameters(rotor=True)`; always of bodies that
            can exist.
        parameter_names_: Base parameters, friction coefficients joint by joint, then shapes.
        coefficients_: Their values, `std_error_` by the delta method.
    """

    estimator: ClassVar[str] = "rigid-diffnea"

    inertial_: FloatArray

    def __init__(
        self,
        *,
        friction: str = "stribeck",
        prior: float = 1e-5,
        sign_width: float = 0.01,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sign_width=sign_width, filters=filters)
        self.friction = choice("friction", friction, tuple(FORMS))
        self.prior = number("prior", prior, above=0.0)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of every linear model, and the full inertial parameters."""
        return super().fitted_arrays() | {"inertial": self.inertial_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.inertial_ = arrays["inertial"]

    def _open(self) -> None:
        super()._open()
        self._form = FORMS[self.friction]
        joints, form = self.joint_names_, self._form
        terms = (f"{joint}.{term}" for joint in joints for term in form.terms)
        shapes = (f"{joint}.{shape.name}" for joint in joints for shape in form.shapes)
        self.parameter_names_ = (*self._base.names, *terms, *shapes)

    def _learn(self, data: Dataset) -> None:
        """Shapes where they start, then fitted to rows of bounded number, then all rows."""
        unknowns = self._unknowns()
        self.coefficients_ = unknowns.at(unknowns.start())[0]
        observed = self._compressed(data)
        fit = DiffneaFit.begun(unknowns, observed, self.prior)
        if self._form.shapes:
            fit = fit.bent(self._bending_rows(data))
            self.coefficients_ = fit.values
            observed = self._compressed(data)
            fit = fit.finished(observed)
        self.inertial_ = fit.inertial
        self.notes_ = fit.notes(self.joint_names_)
        self._adopt(data, fit.solution(observed))

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
        self._tell_uncertainty(data, found)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        straight = np.array(coefficients)
        straight[len(straight) - len(self._form.shapes) * data.n_joints :] = 0.0
        return super()._residual(data, straight)

    def _unknowns(self) -> Unknowns:
        scale = np.ones((len(self.joint_names_), len(self._form.terms)))
        return Unknowns(Bodies.nominal(self.robot_), folding(self._base), self._form, scale)

    def _bending_rows(self, data: Dataset) -> BendingRows:
        every = -(-len(data) // MOST_ROWS)
        parts = [
            (Y.reshape(*qd.shape, -1)[::every], qd[::every], target[::every])
            for _, Y, qd, target in self._rigid_rows(data)
        ]
        Y, qd, target = (np.concatenate(part) for part in zip(*parts, strict=True))
        return BendingRows(Y, qd, sign_of(qd, self.sign_width), target, self._form)

    def _rigid_rows(
        self, data: Dataset
    ) -> Iterator[tuple[slice, FloatArray, FloatArray, FloatArray]]:
        """Rows, base regressor (N·n, b), velocities (N, n) and target torques (N, n), in order."""
        motion = tuple(data[name] for name in MOTION)
        load = payload_torque(self.robot_, data, *motion)
        target = data["effort_f"] * self.torque_scale_ - load
        for rows in chunks(data):
            q, qd, qdd = (values[rows] for values in motion)
            Y = self._base.reduce(self.robot_.regressor(q, qd, qdd, rotor=True))
            yield rows, Y, qd, target[rows]

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        c, shapes = self._friction_values()
        for rows, Y, qd, target in self._rigid_rows(data):
            C, slope = self._form.evaluate(qd, sign_of(qd, self.sign_width), shapes)
            bent = np.einsum("Njks,jk->Njs", slope, c)
            yield rows, np.hstack([Y, spread(C), spread(bent)]), target

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        rigid, still = self.coefficients_[: self._base.rank], np.zeros_like(q)
        c, shapes = self._friction_values()

        def torque(*motion: FloatArray) -> FloatArray:
            columns: FloatArray = self._base.reduce(self.robot_.regressor(*motion, rotor=True))
            return (columns @ rigid).reshape(q.shape)

        gravity = torque(q, still, still)
        C, _ = self._form.evaluate(qd, sign_of(qd, self.sign_width), shapes)
        parts = {
            "gravity": gravity,
            "inertia": torque(q, qd, qdd) - gravity,
            "friction": np.einsum("Njk,jk->Nj", C, c),
        }
        return {name: part / self.torque_scale_ for name, part in parts.items()}

    def _friction_values(self) -> tuple[FloatArray, FloatArray]:
        """(n, k) coefficients and (n, s) shapes."""
        n, k = len(self.joint_names_), len(self._form.terms)
        values = self.coefficients_[self._base.rank :]
        return values[: n * k].reshape(n, k), values[n * k :].reshape(n, -1)
