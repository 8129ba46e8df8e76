"""Method 2 of the PINN paper: least squares under physical consistency (Sousa & Cortesão).

The pseudo-inertia of every link is positive definite and within bounds; rotor inertias and friction
coefficients are at least 0 (`hil.estimators.consistent`). The fit also returns the full inertial
parameters, so that its mass matrices are positive definite at every pose and a URDF can be written.
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
"""Default weight of the prior on the nominal links.

The default weight was chosen on four UR10e training trajectories, each held out in turn. Weights of
1 and 1000 give the same error within one part in four hundred, but with a weight of 1, links become
unrealistically thin.
"""


def feasible(
    solution: Solution, base: BaseParameters, bounds: InertialBounds, prior: float
) -> Consistent:
    """Return the physically consistent solution with the smallest weighted sum of squares.

    Args:
        solution: Unconstrained solution that defines the weights of the joints; base parameters
            first, followed by `TERMS` of each joint.
        base: Base parameters of the robot.
        bounds: Bounds on the inertial parameters of the links.
        prior: Weight of the prior on the nominal links, see `RigidLmi`.
    """
    X, y = solution.weighted_system()
    # The rows are scaled to standard deviations, so that the prior has the same meaning with and
    # without joint weights.
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
    """Return the indices of the dissipative friction columns of all joints: Coulomb and viscous."""
    return np.flatnonzero(np.arange(columns) % len(TERMS) != TERMS.index("offset"))


class RigidLmi(RigidClassical):
    """Physically consistent rigid-body parameters, fitted together with Coulomb–viscous friction.

    Attributes:
        inertial_: (11n,) full parameters in the order of `RobotModel.parameters(rotor=True)`.
        least_eigenvalue_: Smallest eigenvalue of a pseudo-inertia relative to that of the nominal
            link.
        covariance_: Array of NaN, because the covariance is undefined under constraints. The
            attribute `std_error_` contains the standard error of unconstrained least squares, an
            upper bound.
    """

    estimator: ClassVar[str] = "rigid-lmi"
    certain: ClassVar[bool] = False
    inertial_: FloatArray
    least_eigenvalue_: float

    weighted: bool = parameter(
        False,
        flag,
        doc="Weight the joints by their residuals; False is the published method.",
    )
    mass_factor: float = parameter(
        MASS_FACTOR,
        number,
        above=1.0,
        doc="Largest link mass as a multiple of the nominal mass, above 1.",
    )
    prior: float = parameter(
        PRIOR,
        number,
        at_least=0.0,
        doc="Weight of the nominal bodies as prior: with 1, a deviation of a link by 100 % counts "
        "as one additional sample; with 0, there is no prior.",
    )

    def extras(self) -> dict[str, str]:
        """Return the optional dependency that provides a semidefinite-programming solver."""
        return IDENTIFY

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a classical method, and the full inertial parameters."""
        return super().fitted_arrays() | {"inertial": self.inertial_}

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a classical method, and the smallest relative eigenvalue."""
        return super().fitted_facts() | {"least_eigenvalue": self.least_eigenvalue_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
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
