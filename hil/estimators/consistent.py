"""Least squares under the constraint that all links are physically consistent.

Base parameters are a linear function B φ of the full parameters φ, and the pseudo-inertia of every
link must be positive definite, so the problem is a semidefinite program (Sousa & Cortesão, IJRR
2014; IEEE/ASME T-Mech 2019). `inertial_bounds` defines a mass limit and a bounding box for each
link. A body in lo ≤ x ≤ hi satisfies ∫(x − lo)(hi − x) dm ≥ 0, which is linear in φ and bounds the
second moment and thereby the centre of mass (after Wensing, Kim & Slotine, RA-L 2018, who use
ellipsoids).

The problem is solved in coordinates S = C⁻¹ J C⁻ᵀ (`ReferenceCoordinates`), with C Cᵀ the
pseudo-inertia of the reference body. The entries of S are then of order 1 for all links. ‖S − 1‖²
is to second order the geometric distance from the reference, independent of units and frames (Lee,
Wensing & Park, T-RO 2020).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, plugins
from hil.dynamics import PARAMETERS, BaseParameters, from_pseudo_inertia, pseudo_inertia
from hil.estimators.inertial_bounds import InertialBounds
from hil.estimators.least_squares import upper_triangle

LEAST = 1e-3
"""Smallest eigenvalue of S: minimum thickness of a link relative to its reference body."""

FAINT = 1e-6
"""Minimum weight of the prior on the bodies, which makes the solution unique."""

LONGEST = 1e4
"""Norm to which longer target vectors are scaled; weights of noise-free data can reach 1e12."""


@dataclass(frozen=True, slots=True, eq=False)
class Consistent:
    """Physically consistent parameters of a robot.

    Attributes:
        inertial: (11n,) full parameters in the order of `RobotModel.parameters(rotor=True)`.
        extra: (k,) coefficients of the regressor columns that follow the base parameters.
        base: (b,) base parameters of `inertial`.
        excess: Increase of the sum of squares compared with the unconstrained solution.
        least_eigenvalue: Smallest eigenvalue of S over all links; positive, 1 for the reference.
    """

    inertial: FloatArray
    extra: FloatArray
    base: FloatArray
    excess: float
    least_eigenvalue: float

    @property
    def coefficients(self) -> FloatArray:
        """Base parameters followed by the extra coefficients (b + k,)."""
        return np.concatenate([self.base, self.extra])


IDENTIFY = {"identify": "for physically consistent links"}
"""Value of `RobotEstimator.extras` for estimators that use `consistent_least_squares`."""


def consistent_least_squares(
    X: FloatArray,
    y: FloatArray,
    *,
    base: BaseParameters,
    bounds: InertialBounds,
    nonnegative: Sequence[int] = (),
    prior: float | None = None,
) -> Consistent:
    """Minimise ‖X [Bφ, e] − y‖² + prior Σ‖Sᵢ − 1‖² over consistent links and rotors ≥ 0.

    Args:
        X: (m, b + k) rows weighted by 1/σ. The first b columns of X multiply base parameters; the
            other k columns are extra (friction) columns. The computation is fastest for compressed
            rows (`JointwiseQR`).
        y: (m,) target, multiplied by the same weights as X.
        base: Base parameters of the robot, including rotor inertias.
        bounds: Bounds on the inertial parameters of the links.
        nonnegative: Indices of extra coefficients, from 0, that must be at least 0.
        prior: Weight of the distance of the links from the reference bodies. If the rows of X are
            in standard deviations, a prior weight of 1 makes a link deviation of 100 % count like
            one sample. None stands for a prior weight near zero; the bounds then determine those
            directions on which no torque depends.

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
    z[: space.bodies] = space.drawn_inside(z[: space.bodies], 0.5 * LEAST)
    inertial = space.to_parameters @ z[: space.size]
    return Consistent(
        inertial=inertial,
        extra=z[space.size :],
        base=base.combine(inertial),
        excess=float(np.sum((A @ z - target) ** 2)),
        least_eigenvalue=space.least_eigenvalue(z[: space.bodies]),
    )


def _lengths(A: FloatArray, bodies: int) -> FloatArray:
    """Return the column divisors that give rotors and friction the same scale as bodies.

    The columns of bodies are not scaled: their coordinates are of order 1, and scaling would change
    the shape of their cone.
    """
    norms = np.linalg.norm(A, axis=0)
    like = float(norms[:bodies].max())
    divisors = np.where(norms > 0, norms, like) / like
    divisors[:bodies] = 1.0
    return np.asarray(divisors)


def _minimum(
    A: FloatArray, b: FloatArray, space: ReferenceCoordinates, positive: Sequence[int]
) -> FloatArray:
    """Return the minimiser of ‖A z − b‖² with consistent links and z ≥ 0 at `positive`."""
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
            # The warning "Solution may be inaccurate" is ignored, because the caller moves the
            # solution inside the bounds.
            warnings.simplefilter("ignore")
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise _unsolved(str(error)) from error
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise _unsolved(problem.status)
    return np.asarray(z.value)


def _cvxpy() -> Any:
    try:
        import clarabel  # noqa: F401
        import cvxpy
    except ImportError as error:
        absent = [str(error.name)]
        raise plugins.not_installed("a physically consistent fit", absent, "identify") from error
    return cvxpy


def _unsolved(why: str) -> FitError:
    return FitError(
        f"no physically consistent parameters could be found: {why}",
        hint="widen the bounds (mass_factor), or check robot and unit of the data",
    )


BODY = len(PARAMETERS)
_ROWS, _COLUMNS = np.triu_indices(4)


class ReferenceCoordinates:
    """Coordinates s in which the reference body of every link is the unit matrix.

    The pseudo-inertia of a link is J = C S Cᵀ, with C the Cholesky factor of its reference. s
    contains the ten entries of S in an orthonormal basis. In the coordinate vector, the rotor
    inertias follow all links and are not scaled.

    Attributes:
        links: Number n of links.
        bodies: Number 10n of coordinates of all bodies.
        size: Number 11n of coordinates, including rotors.
        symmetric: (16, 10) matrix that maps s of a link to the matrix S of this link.
        to_parameters: (11n, 11n) matrix from coordinates to parameters.
        reference: (10n,) coordinates of the reference bodies.
        limits, room: (4n, 10n) matrix and (4n,) vector of the bounds limits @ s ≤ room.
    """

    def __init__(self, bounds: InertialBounds) -> None:
        self.links = len(bounds.reference)
        self.bodies, self.size = BODY * self.links, (BODY + 1) * self.links
        self.symmetric = _symmetric_basis()
        self.to_parameters = np.eye(self.size)
        self.reference = np.tile(self.symmetric.T @ np.eye(4).ravel(), self.links)
        self.limits = np.zeros((4 * self.links, self.bodies))
        self.room = np.zeros(4 * self.links)
        for i in range(self.links):
            own = slice(BODY * i, BODY * (i + 1))
            T = self._from_entries(bounds.reference[i])
            self.to_parameters[own, own] = T
            rows = _limit_rows(bounds.box[i]) @ T
            # Each bound is scaled by its distance from the reference.
            mass_max = float(bounds.mass_max[i])
            away = np.append(-rows[:3] @ self.reference[own], mass_max)
            rows[3] = T[0]
            self.limits[4 * i : 4 * i + 4, own] = rows / away[:, None]
            self.room[4 * i + 3] = 1.0

    def _from_entries(self, reference: FloatArray) -> FloatArray:
        """Return the (10, 10) matrix that maps s of a link to its inertial parameters."""
        C = np.linalg.cholesky(pseudo_inertia(reference))
        units = self.symmetric.T.reshape(BODY, 4, 4)
        return from_pseudo_inertia(C @ units @ C.T).T

    def matrices(self, s: FloatArray) -> FloatArray:
        """Return (n, 4, 4) the matrix S of every link."""
        return (s.reshape(self.links, BODY) @ self.symmetric.T).reshape(self.links, 4, 4)

    def least_eigenvalue(self, s: FloatArray) -> float:
        """Return the smallest eigenvalue of S over all links."""
        return float(np.linalg.eigvalsh(self.matrices(s)).min())

    def drawn_inside(self, s: FloatArray, least: float) -> FloatArray:
        """Return coordinates (10n,) moved towards the reference until all bounds are satisfied.

        Because the reference is strictly inside the convex bounds, a sufficient step towards the
        reference always exists.
        """
        over = self.limits @ s - self.room
        spare = self.room - self.limits @ self.reference
        lack = least - self.least_eigenvalue(s)
        over, spare = np.append(over, lack), np.append(spare, 1.0 - least)
        broken = over > 0
        share = float(np.max(over[broken] / (over + spare)[broken], initial=0.0))
        return (1.0 - share) * s + share * self.reference


def _symmetric_basis() -> FloatArray:
    """Return the (16, 10) orthonormal map from ten coordinates to a symmetric 4 × 4 matrix."""
    basis = np.zeros((4, 4, BODY))
    size = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
    basis[_ROWS, _COLUMNS, np.arange(BODY)] = size
    basis[_COLUMNS, _ROWS, np.arange(BODY)] = size
    return basis.reshape(16, BODY)


def _limit_rows(box: FloatArray) -> FloatArray:
    """Return (4, 10) rows whose product with the parameters is ≤ 0 for mass inside the box.

    The fourth row, for the mass limit, is zero. Along each axis, ∫(x − lo)(hi − x) dm ≥ 0 means Σ −
    (lo + hi) h + lo hi m ≤ 0, with the second moment Σ and the first moment h.
    """
    rows = np.zeros((4, BODY))
    J = pseudo_inertia(np.eye(BODY))  # (10, 4, 4) contribution of each parameter to J
    for axis in range(3):
        lo, hi = box[0, axis], box[1, axis]
        rows[axis] = J[:, axis, axis] - (lo + hi) * J[:, axis, 3] + lo * hi * J[:, 3, 3]
    return rows
