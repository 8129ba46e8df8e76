"""The rigid body and every joint's friction together, from compressed observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hil.core import FloatArray
from hil.dynamics import BaseParameters
from hil.estimators.consistent import InertialBounds, consistent_least_squares
from hil.estimators.friction.observed import Observed
from hil.estimators.friction.selection import penalised
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares

PRIOR = 1000.0
"""A link that is off its nominal body by 100 % counts like so many samples in standard deviations:
nothing beside minutes of motion, and all there is where a short recording leaves directions open.
On UR10e trajectories left out in turn it costs nothing (.0636 A for 1000, .0638 A for 1)."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Coefficients of one choice of friction groups.

    Attributes:
        rigid: (b,) base parameters.
        friction: Per joint, the coefficients of its groups' columns, in their order.
        sigma: (n,) standard deviation of the residual [N·m].
        weighted: The least-squares solution behind it, unconstrained.
        inertial: (11n,) full parameters of a robot that can exist; None when not asked for.
        grown: (n,) by what factor that made the residual grow; 1 without it.
    """

    rigid: FloatArray
    friction: tuple[FloatArray, ...]
    sigma: FloatArray
    weighted: Solution
    inertial: FloatArray | None = None
    grown: FloatArray | float = 1.0


def solve(
    observed: Observed, chosen: Sequence[Sequence[str]], penalty: FloatArray | None = None
) -> Solved:
    """Least squares with every joint weighted by its own residual.

    Args:
        observed: Observations.
        chosen: Groups per joint.
        penalty: (n,) see `selection.PENALTIES`; none by default.
    """
    ends = _ends(observed, chosen)
    joints = JointwiseQR(observed.joints)
    for j, names in enumerate(chosen):
        R = observed.pooled(j, observed.indices(names))
        if penalty is not None:
            R = np.vstack([R, penalised(observed, j, names, float(penalty[j]))])
        joints.add_joint(j, _spread(R, observed.base, ends[j], ends[-1]), int(observed.rows.sum()))
    found = jointwise_least_squares(joints, weighted=True)
    return _split(found.coefficients, found.sigma, found, observed.base, ends)


def consistent(
    solved: Solved, base: BaseParameters, bounds: InertialBounds, ends: Sequence[int]
) -> Solved:
    """The same with links that can exist (pseudo-inertias positive definite, rotors ≥ 0).

    Args:
        solved: Without that.
        base: Base parameters of the robot.
        bounds: Of its links.
        ends: Columns of friction up to each joint, see `friction_ends`.

    Raises:
        FitError: The solver found no solution.
    """
    X, y = solved.weighted.weighted_system()
    found = consistent_least_squares(X, y, base=base, bounds=bounds, prior=PRIOR)
    whole = _split(found.coefficients, solved.sigma, solved.weighted, base.rank, list(ends))
    grown = _residual(solved.weighted, found.coefficients) / _residual(
        solved.weighted, solved.weighted.coefficients
    )
    sigma = grown * solved.sigma
    return Solved(whole.rigid, whole.friction, sigma, solved.weighted, found.inertial, grown)


def _residual(solution: Solution, coefficients: FloatArray) -> FloatArray:
    """(n,) length of each joint's residual, never 0."""
    X, y, joint = solution.system
    squares = np.bincount(joint, weights=(X @ coefficients - y) ** 2)
    return np.sqrt(np.maximum(squares, 1e-24 * float(y @ y) or 1.0))


def friction_ends(observed: Observed, chosen: Sequence[Sequence[str]]) -> list[int]:
    """(n + 1,) where the friction columns of each joint begin, and where the last ones end."""
    return _ends(observed, chosen)


def _ends(observed: Observed, chosen: Sequence[Sequence[str]]) -> list[int]:
    counts = [len(observed.indices(names)) for names in chosen]
    return [0, *np.cumsum(counts).tolist()]


def _spread(R: FloatArray, base: int, start: int, total: int) -> FloatArray:
    """Rows [F Y τ] of one joint as rows [Y … F … τ] of all columns."""
    k = R.shape[1] - base - 1
    out = np.zeros((len(R), base + total + 1))
    out[:, :base] = R[:, k : k + base]
    out[:, base + start : base + start + k] = R[:, :k]
    out[:, -1] = R[:, -1]
    return out


def _split(
    coefficients: FloatArray, sigma: FloatArray, solution: Solution, base: int, ends: list[int]
) -> Solved:
    friction = coefficients[base:]
    parts = tuple(friction[a:b] for a, b in pairwise(ends))
    return Solved(coefficients[:base], parts, sigma, solution)
