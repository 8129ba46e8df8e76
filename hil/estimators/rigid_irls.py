"""Method 3 of the PINN paper: three nested loops (Han, Wu, Liu & Xiong, T-RO 2020).

The outer loop fits the exponent of the friction fv·|q̇|^α·sign(q̇) of each joint. The middle loop
reweights outlying samples (IRLS), relative to the robust standard deviation of their joint. The
inner loop keeps the robot physically consistent (`hil.estimators.consistent`). The loops are
implemented from their published description; the outer and the inner loop can be switched off.
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
"""Maximum number of rounds of the outer loop."""

EXPONENT_SETTLED = 0.01
NARROWEST = 1e-3
"""Speed range [rad/s] in which the power law of the speed is linear if `sign_width` is 0."""


class RigidIrls(RigidClassical):
    """Rigid-body parameters and friction, fitted by iteratively reweighted least squares.

    Attributes:
        exponent_: (n,) exponent of viscous friction; `std_error_` does not include its uncertainty.
        inertial_: (11n,) full inertial parameters; None if `feasible` is not set.
        scale_: (n,) robust standard deviation of each joint's residual [N·m].
        iterations_: Total number of iterations of the middle loop.
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
        doc="Fit the exponent of viscous friction per joint; False sets the exponent to 1.",
    )
    feasible: bool = parameter(
        True, flag, doc="Keep links and rotors physically consistent and friction dissipative."
    )
    mass_factor: float = parameter(
        MASS_FACTOR,
        number,
        above=1.0,
        doc="Largest link mass as a multiple of the nominal mass, above 1.",
    )
    prior: float = parameter(
        PRIOR, number, at_least=0.0, doc="Weight of the nominal bodies as prior, as in `rigid-lmi`."
    )

    @property
    def certain(self) -> bool:  # type: ignore[override]
        """Whether the standard formula for the covariance of least squares is valid.

        The formula is valid if there are neither bounds nor fitted exponents.
        """
        return not (self.feasible or self.exponent)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a classical method, the exponents, scales and full parameters."""
        full = {} if self.inertial_ is None else {"inertial": self.inertial_}
        own = {"exponent": self.exponent_, "scale": self.scale_}
        return super().fitted_arrays() | own | full

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a classical method, and the number of iterations."""
        return super().fitted_facts() | {"iterations": self.iterations_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
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
        """Return the physically consistent coefficients (p,), computed by the inner loop."""
        bounds = InertialBounds.nominal(self.robot_, mass_factor=self.mass_factor)
        consistent = feasible(solution, self._base, bounds, self.prior)
        self.inertial_ = consistent.inertial
        reached = bounds.reached(self.inertial_, self.joint_names_)
        self.notes_ = (*bounds.notes, *reached)
        return consistent.coefficients

    def _bend(self, data: Dataset, rows: RobustRows, fit: Reweighted) -> float:
        """Run one round of the outer loop, and return the largest change of an exponent."""
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
        """Return (N,) the viscous column of a joint for an exponent, filtered by the settings."""
        width = self.sign_width or NARROWEST
        column = power_of_speed(data["qd_f"][:, joint], exponent, width)
        if not self.filter_columns:
            return column
        return filter_columns(column, data, self.filters)

    def _felt(self) -> BoolArray:
        """Return (n, p) a mask of the parameters that affect the torque of each joint.

        The torque of a joint is not affected by links that precede the joint.
        """
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
