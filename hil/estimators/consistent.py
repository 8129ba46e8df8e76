"""Least squares over parameters of a robot that can exist.

Sousa & Cortesão (IJRR 2014; IEEE/ASME T-Mech 2019): base parameters are B φ of full parameters φ,
and every link's pseudo-inertia must be positive definite, which is a semidefinite program. Links
are bounded by `InertialBounds`: a mass limit, and a box their mass lies in. A body in lo ≤ x ≤ hi
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

from hil.core import BoolArray, FitError, FloatArray, plugins
from hil.dynamics import PARAMETERS, BaseParameters, RobotModel, from_pseudo_inertia, pseudo_inertia
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


MASS_FACTOR = 1.3
"""A link is at most so many times as heavy as its nominal model: cables, covers, drive gains."""

LIGHT = 0.1
"""Share of the arm's mass below which a link counts as that heavy when its mass is bounded: tools
hang on small flanges and are not always declared."""

AT_BOUND = 0.999
"""Share of its greatest mass from which a link counts as being at the bound."""

MARGIN_SHARE = 0.1
"""Share of the arm's reach by which a link may stick out beyond its joints and nominal body."""

MOST_KG = 100.0
"""Bound on a link's mass where neither a nominal mass nor a torque limit is known."""

THINNEST = 0.02
"""A reference body is at least so thick, as a share of its box (standard deviation of mass)."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialBounds:
    """Bounds on the inertial parameters of every link, in Pinocchio's joint frames.

    Torques say nothing about some directions of the inertial parameters: a fit that is only
    physically consistent may put thousands of kilograms where no joint feels them. The robot's
    nominal model and its geometry know better.

    Attributes:
        reference: (n, 10) a body that can exist per link, strictly inside the bounds; the prior
            pulls towards it.
        mass_max: (n,) [kg].
        box: (n, 2, 3) lowest and highest coordinates of a link's mass [m].
        notes: What had to be assumed, for people.
    """

    reference: FloatArray
    mass_max: FloatArray
    box: FloatArray
    notes: tuple[str, ...] = ()

    @classmethod
    def nominal(
        cls,
        robot: RobotModel,
        *,
        mass_factor: float = MASS_FACTOR,
    ) -> InertialBounds:
        """Bounds from a robot's own inertial parameters and geometry.

        A link's box spans its joint, the next one and its nominal body, and a margin. Links whose
        nominal mass is 0 get wide bounds, and a note says so.

        Args:
            robot: The nominal model.
            mass_factor: Most mass of a link as a multiple of its nominal one, or of a tenth of
                the arm's where it is lighter; above 1.
        """
        bodies = robot.parameters(rotor=False).reshape(robot.n, len(PARAMETERS))
        known = bodies[:, 0] > 0
        next_joint = _next_joints(robot)
        reach = float(np.sum(np.linalg.norm(next_joint, axis=1))) or 1.0
        margin = MARGIN_SHARE * reach
        box = np.stack(
            [_box(body, end, margin) for body, end in zip(bodies, next_joint, strict=True)]
        )
        unknown_max = _mass_from_torque(robot, reach)
        heavy = np.maximum(bodies[:, 0], LIGHT * float(np.sum(bodies[:, 0])))
        mass_max = np.where(known, mass_factor * heavy, unknown_max)
        reference = np.stack(
            [_body(b, m, x) for b, m, x in zip(bodies, mass_max, box, strict=True)]
        )
        return cls(reference, mass_max, box, _notes(robot, known, unknown_max))

    def reached(self, inertial: FloatArray, joint_names: tuple[str, ...]) -> tuple[str, ...]:
        """Notes on links of full parameters (11n,) that are as heavy as they may be."""
        masses = inertial[: self.reference.size].reshape(self.reference.shape)[:, 0]
        heavy = masses >= AT_BOUND * self.mass_max
        if not np.any(heavy):
            return ()
        names = ", ".join(name for name, at in zip(joint_names, heavy, strict=True) if at)
        return (
            f"the links behind {names} are as heavy as they may be: was a load mounted that is not "
            "declared, or is the robot's nominal model of another arm?",
        )


def _next_joints(robot: RobotModel) -> FloatArray:
    """(n, 3) where the following joint (or the flange) sits in each joint's frame [m]."""
    still = np.zeros((1, robot.n))
    placement = robot.joint_geometry().placement
    flange = robot.flange_pose(still)[0]
    last = np.eye(4)
    for pose in placement:
        last = last @ pose
    end = np.linalg.solve(last, flange)[:3, 3]
    return np.vstack([placement[1:, :3, 3], end])


def _box(body: FloatArray, end: FloatArray, margin: float) -> FloatArray:
    """(2, 3) lowest and highest corner of the region a link may fill."""
    points = [np.zeros(3), end]
    if body[0] > 0:
        centre = body[1:4] / body[0]
        spread = np.sqrt(np.maximum(np.diag(_central(body)) / body[0], 0.0))
        # Twice the standard deviation of a body's mass is beyond most of what it is made of.
        points += [centre - 2 * spread, centre + 2 * spread]
    return np.stack([np.min(points, axis=0) - margin, np.max(points, axis=0) + margin])


def _central(body: FloatArray) -> FloatArray:
    """(3, 3) second moments of a body's mass about its centre [kg·m²]."""
    J, centre = pseudo_inertia(body), body[1:4] / body[0]
    return np.asarray(J[:3, :3] - body[0] * np.outer(centre, centre))


def _mass_from_torque(robot: RobotModel, reach: float) -> float:
    """Twice what the strongest joint could hold at arm's length [kg]."""
    limited = np.isfinite(robot.effort_max) & (robot.effort_max > 0)
    if not limited.any():
        return MOST_KG
    arm_m = np.where(robot.joint_geometry().turns, reach, 1.0)  # a sliding joint holds by force
    return float(min(2.0 * (robot.effort_max / (9.81 * arm_m))[limited].max(), MOST_KG))


def _body(body: FloatArray, mass_max: float, box: FloatArray) -> FloatArray:
    """(10,) the nominal body made thick enough to exist, or one that fills the box."""
    size = box[1] - box[0]
    if body[0] > 0:
        mass, centre, moments = body[0], body[1:4] / body[0], _central(body)
    else:
        mass, centre, moments = 0.1 * mass_max, box.mean(axis=0), np.zeros((3, 3))
        size = 5.0 * size
    values, vectors = np.linalg.eigh(moments)
    thin = mass * (THINNEST * float(size.min())) ** 2
    moments = (vectors * np.maximum(values, thin)) @ vectors.T
    J = np.zeros((4, 4))
    J[:3, :3] = moments + mass * np.outer(centre, centre)
    J[:3, 3] = J[3, :3] = mass * centre
    J[3, 3] = mass
    return from_pseudo_inertia(J)


def _notes(robot: RobotModel, known: BoolArray, mass_max: float) -> tuple[str, ...]:
    missing = [name for name, there in zip(robot.joint_names, known, strict=True) if not there]
    if not missing:
        return ()
    whose = "any link" if len(missing) == robot.n else f"the links of {', '.join(missing)}"
    return (
        f"the robot model {robot.name} gives no mass of {whose}: up to {mass_max:.3g} kg each are "
        "allowed there, so that directions no joint feels are little more than a guess",
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
