"""Least squares over parameters of a robot that can exist.

Sousa & Cortesão (IJRR 2014; IEEE/ASME T-Mech 2019): base parameters are B φ of full parameters φ,
and every link's pseudo-inertia must be positive definite, which is a semidefinite program. Links
are bounded by `inertial_bounds`: a mass limit, and a box their mass lies in. A body in lo ≤ x ≤ hi
obeys ∫(x − lo)(hi − x) dm ≥ 0, linear in φ; it bounds the second moment and with it the centre of
mass (after Wensing, Kim & Slotine, RA-L 2018, who use ellipsoids).

It is solved in coordinates S = C⁻¹ J C⁻ᵀ (`ReferenceCoordinates`), where C Cᵀ is the pseudo-inertia
of the reference body: all links then have entries around 1, and ‖S − 1‖² is, to second order, the
geometric distance from the reference (Lee, Wensing & Park, T-RO 2020), free of units and frames.
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
"""Least eigenvalue of S: no link is thinner, in any direction, than this share of its reference."""

FAINT = 1e-6
"""Smallest prior on the bodies, so that the solution is unique."""

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
    """

    inertial: FloatArray
    extra: FloatArray
    base: FloatArray
    excess: float
    least_eigenvalue: float

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
            # "Solution may be inaccurate": the caller draws it inside the bounds.
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
        hint="widen the bounds (mass_factor), or check that the data are of this robot and unit",
    )


BODY = len(PARAMETERS)
_ROWS, _COLUMNS = np.triu_indices(4)


class ReferenceCoordinates:
    """Coordinates s in which every link's reference body is the unit matrix.

    A link's pseudo-inertia is J = C S Cᵀ, C the Cholesky factor of its reference; s are the ten
    entries of S in an orthonormal basis. Rotor inertias follow behind all links, unscaled.

    Attributes:
        links: Number of links n.
        bodies: 10n, the coordinates of all bodies.
        size: 11n, rotors included.
        symmetric: (16, 10) from s of a link to its S.
        to_parameters: (11n, 11n) from coordinates to parameters.
        reference: (10n,) coordinates of the reference bodies.
        limits, room: (4n, 10n) and (4n,): the bounds are limits @ s ≤ room.
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
            # Each bound counts in units of how far the reference keeps away from it.
            mass_max = float(bounds.mass_max[i])
            away = np.append(-rows[:3] @ self.reference[own], mass_max)
            rows[3] = T[0]
            self.limits[4 * i : 4 * i + 4, own] = rows / away[:, None]
            self.room[4 * i + 3] = 1.0

    def _from_entries(self, reference: FloatArray) -> FloatArray:
        """(10, 10) from s of a link to its parameters."""
        C = np.linalg.cholesky(pseudo_inertia(reference))
        units = self.symmetric.T.reshape(BODY, 4, 4)
        return from_pseudo_inertia(C @ units @ C.T).T

    def matrices(self, s: FloatArray) -> FloatArray:
        """(n, 4, 4) S of every link."""
        return (s.reshape(self.links, BODY) @ self.symmetric.T).reshape(self.links, 4, 4)

    def least_eigenvalue(self, s: FloatArray) -> float:
        """Smallest eigenvalue of any link's S."""
        return float(np.linalg.eigvalsh(self.matrices(s)).min())

    def drawn_inside(self, s: FloatArray, least: float) -> FloatArray:
        """Return coordinates (10n,) drawn to the reference until all bounds hold.

        The reference is strictly inside and the bounds are convex, so a share below 1 is enough.
        """
        over = self.limits @ s - self.room
        spare = self.room - self.limits @ self.reference
        lack = least - self.least_eigenvalue(s)
        over, spare = np.append(over, lack), np.append(spare, 1.0 - least)
        broken = over > 0
        share = float(np.max(over[broken] / (over + spare)[broken], initial=0.0))
        return (1.0 - share) * s + share * self.reference


def _symmetric_basis() -> FloatArray:
    """(16, 10) from ten coordinates to the entries of a symmetric 4 × 4 matrix, orthonormal."""
    basis = np.zeros((4, 4, BODY))
    size = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
    basis[_ROWS, _COLUMNS, np.arange(BODY)] = size
    basis[_COLUMNS, _ROWS, np.arange(BODY)] = size
    return basis.reshape(16, BODY)


def _limit_rows(box: FloatArray) -> FloatArray:
    """(4, 10) rows that must be ≤ 0 for mass inside the box; the last, for its mass, is left empty.

    Along each axis ∫(x − lo)(hi − x) dm ≥ 0, that is Σ − (lo + hi) h + lo hi m ≤ 0 with the second
    moment Σ and the first moment h.
    """
    rows = np.zeros((4, BODY))
    J = pseudo_inertia(np.eye(BODY))  # (10, 4, 4): what each parameter adds to J
    for axis in range(3):
        lo, hi = box[0, axis], box[1, axis]
        rows[axis] = J[:, axis, axis] - (lo + hi) * J[:, axis, 3] + lo * hi * J[:, 3, 3]
    return rows
