"""The quadratic program of one step, by an interior-point method (Clarabel)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray

TOLERANCE = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A solution.

    Attributes:
        move: (v,).
        excess: What no step can mend of the elastic rows, at least 0.
        hard, elastic: Multipliers of the rows.
    """

    move: FloatArray
    excess: float
    hard: FloatArray
    elastic: FloatArray


def solve_step(
    hessian: FloatArray,
    gradient: FloatArray,
    hard: tuple[FloatArray, FloatArray],
    elastic: tuple[FloatArray, FloatArray],
    penalty: float,
) -> Step | None:
    """Minimise gᵀd + dᵀHd/2 + penalty·t with A d ≤ b, C d ≤ c + t and t ≥ 0.

    Args:
        hessian: (v, v), positive definite.
        gradient: (v,).
        hard: A and b.
        elastic: C and c.
        penalty: Of t.

    Returns:
        None where the solver does not succeed.
    """
    import clarabel
    import scipy.sparse

    (A, b), (C, c) = hard, elastic
    size, soft = len(gradient), int(len(c) > 0)
    H = np.zeros((size + soft, size + soft))
    H[:size, :size] = np.triu(hessian)
    rows = np.zeros((len(b) + len(c) + soft, size + soft))
    rows[: len(b), :size], rows[len(b) : len(b) + len(c), :size] = A, C
    if soft:
        H[size, size] = 1e-9 * penalty
        rows[len(b) :, size] = -1.0
    bounds = np.concatenate([b, c, np.zeros(soft)])
    costs = np.concatenate([gradient, np.full(soft, penalty)])
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    cones = [clarabel.NonnegativeConeT(len(bounds))]
    found = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix(H), costs, scipy.sparse.csc_matrix(rows), bounds, cones, settings
    ).solve()
    if str(found.status) not in ("Solved", "AlmostSolved"):
        return None
    x, multipliers = np.array(found.x), np.array(found.z)
    excess = float(max(x[size], 0.0)) if soft else 0.0
    return Step(x[:size], excess, multipliers[: len(b)], multipliers[len(b) : len(b) + len(c)])


def damped_update(hessian: FloatArray, way: FloatArray, turned: FloatArray) -> FloatArray:
    """BFGS from a way (v,) and the change of the gradient along it; stays positive definite.

    Damped as by Powell 1978 where the curvature along the way is not positive.
    """
    along = hessian @ way
    old, new = float(way @ along), float(way @ turned)
    if not old > 0:
        return hessian
    share = 1.0 if new >= 0.2 * old else 0.8 * old / (old - new)
    mixed = share * turned + (1.0 - share) * along
    return hessian + np.outer(mixed, mixed) / (way @ mixed) - np.outer(along, along) / old
