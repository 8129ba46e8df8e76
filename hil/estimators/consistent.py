"""Least squares over parameters of a robot that can exist.

Sousa & Cortesão (IJRR 2014; IEEE/ASME T-Mech 2019): base parameters are B φ of full parameters φ,
and every link's pseudo-inertia must be positive definite, which is a semidefinite program. Links
are bounded by `InertialBounds`: a mass limit, and a box their mass lies in. A body in lo ≤ x ≤ hi
obeys ∫(x − lo)(hi − x) dm ≥ 0, linear in φ; it bounds the second moment and with it the centre of
mass (after Wensing, Kim & Slotine, RA-L 2018, who use ellipsoids).

It is solved in coordinates S = C⁻¹ J C⁻ᵀ, where C Cᵀ is the pseudo-inertia of the reference body:
all links then have entries around 1, and ‖S − 1‖² is, to second order, the geometric distance from
the reference (Lee, Wensing & Park, T-RO 2020), free of units and frames.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, plugins
from hil.dynamics import BaseParameters
from hil.estimators.inertial_bounds import InertialBounds
from hil.estimators.least_squares import upper_triangle
from hil.estimators.reference_coordinates import ReferenceCoordinates

LEAST = 1e-3
"""Least eigenvalue of S: no link is thinner, in any direction, than this share of its reference."""

FAINT = 1e-6
"""Prior that is always there, so that the solution is unique."""

LONGEST = 1e4
"""The target is scaled down to this length at most: noise-free data weigh 1e12."""


@dataclass(frozen=True, slots=True, eq=False)
class Consistent:
    """Parameters of a robot that can exist.

    Attributes:
        inertial: (11n,) in the order of `RobotModel.parameters(rotor=True)`.
        extra: (k,) coefficients of the columns behind the base parameters'.
        base: (b,) base parameters of `inertial`.
        excess: By how much the sum of squares grew over the unconstrained one.
        least_eigenvalue: Smallest eigenvalue of any link's S; positive, 1 at the reference.
        repaired: Share by which the solver's answer had to be drawn to the reference until it was
            strictly inside the bounds; around 1e-9 as a rule.
    """

    inertial: FloatArray
    extra: FloatArray
    base: FloatArray
    excess: float
    least_eigenvalue: float
    repaired: float

    @property
    def coefficients(self) -> FloatArray:
        """(b + k,) base parameters, then the extra ones."""
        return np.concatenate([self.base, self.extra])


IDENTIFY = {"identify": "for links that can exist"}
"""`RobotEstimator.extras` of whatever calls `consistent_least_squares` in a fit."""


def consistent_least_squares(
    X: FloatArray,
    y: FloatArray,
    *,
    base: BaseParameters,
    bounds: InertialBounds,
    nonnegative: Sequence[int] = (),
    prior: float | None = None,
) -> Consistent:
    """Minimise ‖X [Bφ, e] − y‖² + prior Σ‖Sᵢ − 1‖² over links that can exist and rotors ≥ 0.

    Args:
        X: (m, b + k) rows weighted by 1/σ; the first b columns multiply base parameters, the k
            others are extra (friction) columns. Compressed rows (`JointwiseQR`) cost least.
        y: (m,) target, weighted alike.
        base: Base parameters of the robot, rotor inertias included.
        bounds: Of its links.
        nonnegative: Which of the extra coefficients, from 0, cannot be below 0.
        prior: Weight of the distance from the reference bodies: with rows in standard deviations,
            1 counts a link's being off by 100 % like one more sample. None is next to nothing:
            directions that no torque shows are then held by the bounds.

    Raises:
        FitError: The solver found no solution.
        PluginError: cvxpy or Clarabel is not installed.
    """
    space = ReferenceCoordinates(bounds)
    b, k = base.rank, X.shape[1] - base.rank
    full = np.zeros((b, space.size))
    full[:, base.independent] = np.eye(b)
    full[:, base.dependent] = base.combination
    triangle = upper_triangle(np.column_stack([X, y]))[: b + k]
    factor, target = triangle[:, :-1], triangle[:, -1]
    A = np.hstack([factor[:, :b] @ full @ space.to_parameters, factor[:, b:]])
    shrink = 1.0 / max(1.0, float(np.linalg.norm(target)) / LONGEST)
    length = _lengths(A, space.bodies)
    pull = np.zeros((space.bodies, A.shape[1]))
    pull[:, : space.bodies] = np.sqrt(max((prior or 0.0) * shrink**2, FAINT)) * np.eye(space.bodies)
    rows = np.vstack([shrink * A / length, pull])
    wanted = np.concatenate([shrink * target, pull[:, : space.bodies] @ space.reference])
    positive = [*range(space.bodies, space.size), *(space.size + i for i in nonnegative)]
    z = _minimum(rows, wanted, space, positive) / length
    z[positive] = np.maximum(z[positive], 0.0)
    z[: space.bodies], repaired = space.strictly_inside(z[: space.bodies], 0.5 * LEAST)
    inertial = space.to_parameters @ z[: space.size]
    return Consistent(
        inertial=inertial,
        extra=z[space.size :],
        base=base.combine(inertial),
        excess=float(np.sum((A @ z - target) ** 2)),
        least_eigenvalue=space.least_eigenvalue(z[: space.bodies]),
        repaired=repaired,
    )


def _lengths(A: FloatArray, bodies: int) -> FloatArray:
    """Divisors of the columns that make rotors and friction count like bodies.

    Bodies stay as they are: their coordinates are of order 1, and their cone must keep its form.
    """
    norms = np.linalg.norm(A, axis=0)
    like = float(norms[:bodies].max())
    divisors = np.where(norms > 0, norms, like) / like
    divisors[:bodies] = 1.0
    return np.asarray(divisors)


def _minimum(
    A: FloatArray, b: FloatArray, space: ReferenceCoordinates, positive: Sequence[int]
) -> FloatArray:
    """Argmin ‖A z − b‖² over consistent links and z ≥ 0 where `positive`."""
    cp = _cvxpy()
    z = cp.Variable(A.shape[1])
    inside = space.limits @ z[: space.bodies] <= space.room
    constraints = [inside, z[list(positive)] >= 0]
    for link in range(space.links):
        entries = space.symmetric @ z[10 * link : 10 * link + 10]
        S = cp.reshape(entries, (4, 4), order="C")
        constraints.append(S >> LEAST * np.eye(4))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(A @ z - b)), constraints)
    try:
        with warnings.catch_warnings():
            # "Solution may be inaccurate": it is checked and drawn inside the bounds below.
            warnings.simplefilter("ignore")
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise _unsolved(str(error)) from error
    if z.value is None:
        raise _unsolved(problem.status)
    return np.asarray(z.value)


def _unsolved(why: str) -> FitError:
    return FitError(
        f"no physically consistent parameters could be found: {why}",
        hint="widen the bounds (mass_factor), or check that the data are of this robot and unit",
    )


def _cvxpy() -> Any:
    try:
        import clarabel  # noqa: F401
        import cvxpy
    except ImportError as error:
        absent = [str(error.name)]
        raise plugins.not_installed("a physically consistent fit", absent, "identify") from error
    return cvxpy
