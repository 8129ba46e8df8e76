"""Method 3 of the PINN paper: three loops around least squares (Han, Wu, Liu & Xiong, T-RO 2020).

The outer loop bends friction, fv·|q̇|^α·sign(q̇), one exponent per joint; the middle one reweights
samples that do not fit (IRLS), each joint in units of its own robust deviation; the inner one keeps
the robot physically feasible (`hil.estimators.consistent`). The published loops restored from their
description; each of them can be left out.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.data import Dataset, filter_columns
from hil.estimators.checks import require_sizes
from hil.estimators.friction_curve import best_exponent, power_of_speed
from hil.estimators.inertial_bounds import MASS_FACTOR, InertialBounds
from hil.estimators.least_squares import Solution
from hil.estimators.parameters import choice, flag, number, parameter
from hil.estimators.rigid_linear import TERMS, RigidClassical
from hil.estimators.rigid_lmi import PRIOR, feasible
from hil.estimators.robust import (
    LOSSES,
    Loss,
    Reweighted,
    Reweighting,
    RobustRows,
    influence_slope,
    robust_weights,
)

MOST_OUTER = 8
"""Rounds of the outer loop."""

EXPONENT_SETTLED = 0.01
NARROWEST = 1e-3
"""Width [rad/s] within which a power of speed is linear where `sign_width` is 0."""


class RigidIrls(RigidClassical):
    """Rigid-body parameters and friction by iteratively reweighted least squares.

    Attributes:
        exponent_: (n,) of viscous friction; its uncertainty is not in `std_error_`.
        inertial_: (11n,) full parameters; None unless `feasible`.
        scale_: (n,) robust deviation of each joint's residual [N·m].
        iterations_: Of the middle loop, all in all.
    """

    estimator: ClassVar[str] = "rigid-irls"
    bends: ClassVar[bool] = True
    exponent_: FloatArray
    scale_: FloatArray
    inertial_: FloatArray | None = None
    iterations_: int

    loss: Loss = parameter("huber", choice, LOSSES, doc="`huber` or `tukey`.")
    exponent: bool = parameter(
        True,
        flag,
        doc="Fit the exponent of viscous friction per joint; False keeps it at 1.",
    )
    feasible: bool = parameter(
        True, flag, doc="Keep links and rotors physically consistent and friction dissipative."
    )
    mass_factor: float = parameter(
        MASS_FACTOR,
        number,
        above=1.0,
        doc="Most mass of a link as a multiple of its nominal one, above 1.",
    )
    prior: float = parameter(
        PRIOR, number, at_least=0.0, doc="Pull towards the nominal bodies, as in `rigid-lmi`."
    )

    @property
    def certain(self) -> bool:  # type: ignore[override]
        """Bounds and fitted exponents have no covariance of least squares."""
        return not (self.feasible or self.exponent)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of every classical method; exponents, scales, and full parameters if any."""
        full = {} if self.inertial_ is None else {"inertial": self.inertial_}
        own = {"exponent": self.exponent_, "scale": self.scale_}
        return super().fitted_arrays() | own | full

    def fitted_facts(self) -> dict[str, Any]:
        """Those of every classical method, and how many iterations it took."""
        return super().fitted_facts() | {"iterations": self.iterations_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.exponent_, self.scale_ = arrays["exponent"], arrays["scale"]
        self.inertial_ = arrays.get("inertial")
        require_sizes(self, exponent=self.robot_.n)
        if self.inertial_ is not None:
            require_sizes(self, inertial=11 * self.robot_.n)
        self.iterations_ = int(facts["iterations"])

    def _learn(self, data: Dataset) -> None:
        self.exponent_, self.iterations_ = np.ones(data.n_joints), 0
        rows = RobustRows.of(self._observations(data), self._felt())
        loops = Reweighting(rows, self.loss, self._consistent if self.feasible else None)
        fit = loops.run(None)
        self.iterations_ += fit.iterations
        for _ in range(MOST_OUTER if self.exponent else 0):
            moved = self._bend(data, rows, fit)
            fit = loops.run(fit)
            self.iterations_ += fit.iterations
            if moved < EXPONENT_SETTLED:
                break
        self.scale_ = fit.scale
        self._adopt(data, fit.solution)

    def _consistent(self, solution: Solution) -> FloatArray:
        """The inner loop: coefficients (p,) of a robot that can exist."""
        bounds = InertialBounds.nominal(self.robot_, mass_factor=self.mass_factor)
        consistent = feasible(solution, self._base, bounds, self.prior)
        self.inertial_ = consistent.inertial
        reached = bounds.reached(self.inertial_, self.joint_names_)
        self.notes_ = (*bounds.notes, *reached)
        return consistent.coefficients

    def _bend(self, data: Dataset, rows: RobustRows, fit: Reweighted) -> float:
        """One round of the outer loop; returns by how much the exponents moved."""
        before, b = self.exponent_, self._base.rank
        rest, after = rows.residual(fit.solution.coefficients), before.copy()
        for j in range(len(before)):
            own = b + len(TERMS) * j + np.arange(len(TERMS))
            columns = rows.blocks[j][:, np.searchsorted(rows.columns[j], own)]

            def power(exponent: float, j: int = j) -> FloatArray:
                return self._power(data, exponent, j)

            torque = rest[:, j] + columns @ fit.solution.coefficients[own]
            others = np.delete(columns, TERMS.index("viscous"), axis=1)
            after[j] = best_exponent(torque, others, power, fit.weight[:, j], before[j])
            rows.replace(j, int(own[TERMS.index("viscous")]), power(after[j]))
        self.exponent_ = after
        return float(np.max(np.abs(after - before)))

    def _friction(self, qd: FloatArray) -> dict[str, FloatArray]:
        width = self.sign_width or NARROWEST
        return super()._friction(qd) | {"viscous": power_of_speed(qd, self.exponent_, width)}

    def _power(self, data: Dataset, exponent: float, joint: int) -> FloatArray:
        """(N,) viscous column of one joint at an exponent, filtered as the others are."""
        width = self.sign_width or NARROWEST
        column = power_of_speed(data["qd_f"][:, joint], exponent, width)
        if not self.filter_columns:
            return column
        return filter_columns(column, data, self.filters)

    def _felt(self) -> BoolArray:
        """(n, p) which joint feels which parameter: no link before its own."""
        n, rotor = len(self.joint_names_), True
        q, qd, qdd = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 20, n))
        W = self._base.reduce(self.robot_.regressor(q, qd, qdd, rotor=rotor))
        rigid = np.any(W.reshape(20, n, -1) != 0.0, axis=0)
        return np.hstack([rigid, np.kron(np.eye(n, dtype=bool), np.ones(len(TERMS), bool))])

    def _sample_weights(
        self, rest: FloatArray, solution: Solution
    ) -> tuple[FloatArray, FloatArray]:
        z = rest * np.sqrt(solution.weight)
        weight, slope = robust_weights(z, self.loss), influence_slope(z, self.loss)
        return weight * solution.weight, slope * solution.weight
