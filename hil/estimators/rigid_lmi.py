"""Method 2 of the PINN paper: least squares over robots that can exist (Sousa & Cortesão).

Every link's pseudo-inertia is positive definite and within bounds, rotor inertias and friction
coefficients are not below 0; see `hil.estimators.consistent`. The full inertial parameters come
with it, so that mass matrices are positive definite at every pose and a URDF can be written.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from hil.core import FloatArray, IntArray
from hil.dynamics import BaseParameters
from hil.estimators.checks import require_sizes
from hil.estimators.consistent import IDENTIFY, Consistent, consistent_least_squares
from hil.estimators.inertial_bounds import MASS_FACTOR, InertialBounds
from hil.estimators.least_squares import (
    JointwiseQR,
    Solution,
    at_least_rounding,
    jointwise_least_squares,
)
from hil.estimators.parameters import flag, number, parameter
from hil.estimators.rigid_linear import TERMS, RigidClassical

PRIOR = 100.0
"""Chosen on the UR10e's four training trajectories, each left out in turn; 1 and 1000 do as well to
one part in four hundred, but with 1 links come out thinner than they can be built."""


def feasible(
    solution: Solution, base: BaseParameters, bounds: InertialBounds, prior: float
) -> Consistent:
    """The consistent solution with the least sum of squares in the weighting of another one.

    Args:
        solution: Without constraints; base parameters first, then `TERMS` joint by joint.
        base: Base parameters of the robot.
        bounds: Of its links.
        prior: See `RigidLmi`.
    """
    X, y = solution.weighted_system()
    # Unweighted rows are in N·m: in standard deviations the prior means the same for both.
    sigma = at_least_rounding(solution.sigma, solution.system[1])
    pooled = np.sqrt(np.mean(solution.weight * sigma**2))
    return consistent_least_squares(
        X / pooled,
        y / pooled,
        base=base,
        bounds=bounds,
        nonnegative=dissipative(X.shape[1] - base.rank).tolist(),
        prior=prior or None,
    )


def dissipative(columns: int) -> IntArray:
    """Which of the friction columns of all joints take energy out: Coulomb and viscous."""
    return np.flatnonzero(np.arange(columns) % len(TERMS) != TERMS.index("offset"))


class RigidLmi(RigidClassical):
    """Physically consistent rigid-body parameters and Coulomb–viscous friction.

    Attributes:
        inertial_: (11n,) in the order of `RobotModel.parameters(rotor=True)`.
        least_eigenvalue_: Smallest eigenvalue of any pseudo-inertia relative to its nominal one.
        covariance_: NaN: bounds have no such thing. `std_error_` is that of least squares without
            constraints, an upper bound.
    """

    estimator: ClassVar[str] = "rigid-lmi"
    certain: ClassVar[bool] = False
    inertial_: FloatArray
    least_eigenvalue_: float

    weighted: bool = parameter(
        False,
        flag,
        doc="Weight the joints by their residual; False is the method as published.",
    )
    mass_factor: float = parameter(
        MASS_FACTOR,
        number,
        above=1.0,
        doc="Most mass of a link as a multiple of its nominal one, above 1.",
    )
    prior: float = parameter(
        PRIOR,
        number,
        at_least=0.0,
        doc="Pull towards the nominal bodies: 1 counts a link's being off by 100 % like one more "
        "sample; 0 for none.",
    )

    def extras(self) -> dict[str, str]:
        """A solver of semidefinite programs."""
        return IDENTIFY

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of every classical method, and the full inertial parameters."""
        return super().fitted_arrays() | {"inertial": self.inertial_}

    def fitted_facts(self) -> dict[str, Any]:
        """Those of every classical method, and how far the links are from impossible."""
        return super().fitted_facts() | {"least_eigenvalue": self.least_eigenvalue_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.inertial_ = arrays["inertial"]
        require_sizes(self, inertial=11 * self.robot_.n)
        self.least_eigenvalue_ = float(facts["least_eigenvalue"])

    def _estimate(self, observed: JointwiseQR) -> Solution:
        plain = jointwise_least_squares(observed, weighted=self.weighted)
        bounds = InertialBounds.nominal(self.robot_, mass_factor=self.mass_factor)
        consistent = feasible(plain, self._base, bounds, self.prior)
        self.inertial_ = consistent.inertial
        reached = bounds.reached(self.inertial_, self.joint_names_)
        self.notes_ = (*bounds.notes, *reached)
        self.least_eigenvalue_ = consistent.least_eigenvalue
        coefficients = consistent.coefficients
        return replace(plain, coefficients=coefficients, sigma=observed.residual_std(coefficients))
