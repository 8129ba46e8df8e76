"""Optimised Fourier excitation of a UR5 from random starts, against SciPy's SLSQP.

The base regressor has 36 unscaled columns (no rotors), the series five harmonics and 10 s: 66
coefficients. |qd| ≤ 2 rad/s, |qdd| ≤ 6 rad/s²; the position box is the arm's own, ±360° for every
joint, and `box_deg` gives another.

The condition number of unscaled columns depends on which columns stand for those that depend on
them. `ours` are the ones a pivoted QR of a random regressor keeps, the usual choice; what it keeps
depends on the random samples, so two more of its choices are shown. `leftmost` are those of
`hil.dynamics.base_parameters`, which depend on nothing random.

SciPy's SLSQP minimises the logarithm of the same condition number on the same samples from the same
starts, with its finite differences and with our exact gradient, so that method and gradient can be
told apart; all limits on all samples are one matrix. One BLAS thread; CPU seconds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.excite_peers.pivoted import pivoted_base
from benchmarks.excite_peers.slsqp import Slsqp
from hil.arms import load_arm
from hil.dynamics import CollisionModel, Environment, RobotModel, conditioning
from hil.excitation.optimiser import optimise, within_linear_limits
from hil.excitation.problem import ExcitationProblem, LinearLimits, margins_of

ARM = "ur5"
SPEED, ACCELERATION = 2.0, 6.0
STARTS, QUICK_STARTS = 10, 2
ITERATIONS, QUICK_ITERATIONS = 200, 20
PEER_ITERATIONS, QUICK_PEER_ITERATIONS = 200, 3
OTHER_PIVOTS = (1, 2)
CLEARANCE_M = 0.03
DENSER_POINTS = 1000
"""Ten times the objective's samples."""

PEERS = {"slsqp_differences": False, "slsqp_our_gradient": True}
"""Whether it is given our gradient."""


class Outcome(NamedTuple):
    """Of one start.

    Attributes:
        condition: Unscaled, of the result.
        cpu_s: CPU time.
        exceeded: Largest share by which a limit is exceeded on the denser grid, 0 for none.
    """

    condition: float
    cpu_s: float
    exceeded: float


def run(
    quick: bool = False,
    seeds: Sequence[int] | None = None,
    box_deg: float = 360.0,
    iterations: int = 0,
    peers: bool = True,
) -> dict[str, Any]:
    """Condition number and CPU time of every start, ours and SciPy's.

    Args:
        quick: Two starts, few iterations, no collisions.
        seeds: Of the starts; 0 to 9 by default.
        box_deg: Joint positions stay within ± this.
        iterations: Of SciPy's SLSQP at most; 200 by default.
        peers: Whether SciPy takes part; it takes most of the time.
    """
    chosen = tuple(seeds) if seeds else tuple(range(QUICK_STARTS if quick else STARTS))
    ours = QUICK_ITERATIONS if quick else ITERATIONS
    theirs = iterations or (QUICK_PEER_ITERATIONS if quick else PEER_ITERATIONS)
    robot = RobotModel.from_arm(ARM)
    base = pivoted_base(robot)
    problem = _problem(robot, box_deg, base=base)
    with threadpool_limits(1):
        optimise(problem, starts=1, iterations=2)  # imports are nobody's
        told = {"ours": _ours("ours", problem, chosen, ours)}
        told["leftmost"] = _ours("leftmost", _problem(robot, box_deg), chosen, ours)
        if not quick:
            for other in OTHER_PIVOTS:
                another = _problem(robot, box_deg, base=pivoted_base(robot, other))
                told[f"pivoted_{other}"] = _ours(f"pivoted_{other}", another, chosen, ours)
            clear = _problem(robot, box_deg, base=base, **_surroundings(robot))
            told["with_collisions"] = _ours("with_collisions", clear, chosen, ours)
        for name, exact in (PEERS if peers else {}).items():
            told[name] = _theirs(name, problem, chosen, theirs, exact)
    figures: dict[str, float] = {"starts": len(chosen), "box_deg": box_deg}
    for name, outcomes in told.items():
        figures |= _figures(name, outcomes)
    return {"name": "excite", "figures": figures, "ratios": _ratios(told)}


def _problem(robot: RobotModel, box_deg: float, **more: Any) -> ExcitationProblem:
    box = float(np.radians(box_deg))
    return ExcitationProblem(robot, -box, box, SPEED, ACCELERATION, scaled=False, **more)


def _surroundings(robot: RobotModel) -> dict[str, Any]:
    """Return the surroundings of an arm on a table: 30 mm clearance, torques within limits."""
    collision = CollisionModel(load_arm(ARM), Environment(table_z=0.0))
    return {
        "collision": collision,
        "clearance_m": CLEARANCE_M,
        "effort_max": robot.effort_max,
    }


def _ours(
    name: str, problem: ExcitationProblem, seeds: Sequence[int], iterations: int
) -> list[Outcome]:
    outcomes = []
    for seed in seeds:
        found = optimise(problem, starts=1, seed=seed, iterations=iterations)
        exceeded = _exceeded(problem, found.series)
        outcomes.append(Outcome(found.condition_raw, found.cpu_s, exceeded))
        _tell(name, seed, found.starts[0].drawn, outcomes[-1])
    return outcomes


def _theirs(
    name: str, problem: ExcitationProblem, seeds: Sequence[int], iterations: int, exact: bool
) -> list[Outcome]:
    peer, limits, outcomes = _peer(problem), LinearLimits(problem), []
    for seed in seeds:
        free = within_linear_limits(limits, np.random.default_rng((seed, 0)))
        start = problem.basis.series(free)
        began = time.process_time()
        series = peer.minimise(start, iterations, exact)
        cpu_s = time.process_time() - began
        condition = conditioning(problem.regressor(series)).raw
        outcomes.append(Outcome(condition, cpu_s, _exceeded(problem, series)))
        _tell(name, seed, conditioning(problem.regressor(start)).raw, outcomes[-1])
    return outcomes


def _peer(problem: ExcitationProblem) -> Slsqp:
    assert problem.base is not None
    return Slsqp(
        problem.robot,
        problem.base.independent,
        (float(problem.limit("q_max")[0]), SPEED, ACCELERATION),
        problem.harmonics,
        problem.fundamental_hz,
        problem.points,
    )


def _exceeded(problem: ExcitationProblem, series: Any) -> float:
    margins = margins_of(problem, series, DENSER_POINTS)
    shares = (margins.velocity, margins.acceleration, margins.position_rad, margins.effort)
    least = min(float(np.min(share)) for share in shares if share is not None)
    return max(0.0, -min(least, margins.clearance_m or 0.0))


def _tell(name: str, seed: int, drawn: float, outcome: Outcome) -> None:
    kept = "kept" if outcome.exceeded <= 1e-9 else f"exceeded by {100 * outcome.exceeded:.1f} %"
    print(
        f"{name:18} seed {seed}: {drawn:8.1f} → {outcome.condition:7.3f}  "
        f"{outcome.cpu_s:6.2f} CPU s  limits {kept}",
        file=sys.stderr,
    )


def _figures(name: str, outcomes: Sequence[Outcome]) -> dict[str, float]:
    conditions, cpu_s, exceeded = (np.array(x) for x in zip(*outcomes, strict=True))
    return {
        f"{name}_median_condition": float(np.median(conditions)),
        f"{name}_worst_condition": float(conditions.max()),
        f"{name}_best_condition": float(conditions.min()),
        f"{name}_median_cpu_s": float(np.median(cpu_s)),
        f"{name}_worst_cpu_s": float(cpu_s.max()),
        f"{name}_largest_excess": float(exceeded.max()),
    }


def _ratios(told: dict[str, list[Outcome]]) -> dict[str, float]:
    """How many times better conditioned and how many times sooner ours is, in the median."""
    ours = np.median(told["ours"], axis=0)
    out = {}
    for name in PEERS.keys() & told.keys():
        theirs = np.median(told[name], axis=0)
        out[f"condition_vs_{name}"] = float(theirs[0] / ours[0])
        out[f"cpu_vs_{name}"] = float(theirs[1] / ours[1])
    return out


if __name__ == "__main__":
    print(run())
