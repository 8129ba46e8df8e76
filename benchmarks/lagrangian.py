"""Lagrangian networks: speed beside other ways to differentiate, and time to a validation error.

First the torque of a 3×128 network and its gradient by the weights, in single precision on one
thread. Ours against layer Jacobians as the public DeLaN propagates them (and `lean`, the same
without multiplying diag(g′)·W out), and against torch.func by one tangent and by whole Hessians.
Everybody's torques are compared in double precision before anything is timed; contestants take
turns, and medians of CPU time count.

Then training: a mock UR5, nine trajectories of which two validate. CPU time until the validation
error is `TARGET_NRMSE` with our settings, with the paper's layer in our training, and with all the
paper's literal settings. Who does not get there is charged for all his time, so that the ratio is a
lower bound (`…_nrmse` says how far he got). `…_at_its_best` are ratios of times to the least error
that the peer ever had.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from statistics import median
from typing import Any

from threadpoolctl import threadpool_limits

BATCHES, QUICK_BATCHES = (50, 512, 2048), (50,)
ROUNDS, QUICK_ROUNDS = 40, 2
BUDGET_S, QUICK_BUDGET_S = 3.0, 0.5
LIMIT_S, QUICK_LIMIT_S = 60.0, 1.0
TARGET_NRMSE, QUICK_TARGET_NRMSE = 0.2, 0.9
PASSES = ("forward", "both")


def run(quick: bool = False, seeds: Sequence[int] | None = None) -> dict[str, Any]:
    """Milliseconds by contestant, pass and batch; CPU seconds to the validation error.

    Args:
        quick: One batch, few turns, and a short training.
        seeds: Of robots and networks that are trained; 1 alone by default. With several, ratios
            are medians.
    """
    if find_spec("torch") is None:
        reason = "torch is not installed (pip install 'hil[learn]')"
        return {"name": "lagrangian", "figures": {}, "ratios": {}, "skipped": {"all": reason}}
    chosen = tuple(dict.fromkeys(seeds or (1,)))
    with threadpool_limits(1):
        figures, ratios = _speed(quick)
        for part, found in zip((figures, ratios), _training(quick, chosen), strict=True):
            part.update(found)
    return {"name": "lagrangian", "figures": figures, "ratios": ratios}


def _speed(quick: bool) -> tuple[dict[str, float], dict[str, float]]:
    import torch

    from benchmarks.lagrangian_peers.speed import times

    figures: dict[str, float] = {}
    ratios: dict[str, float] = {}
    rounds, budget = (QUICK_ROUNDS, QUICK_BUDGET_S) if quick else (ROUNDS, BUDGET_S)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for batch in QUICK_BATCHES if quick else BATCHES:
            told = times(batch, budget, rounds)
            figures |= {f"{key}_{batch}_ms": value for key, value in told.items()}
            ratios |= _ratios(told, batch)
    finally:
        torch.set_num_threads(threads)
    return figures, ratios


def _ratios(told: dict[str, float], batch: int) -> dict[str, float]:
    """How many times quicker ours is."""
    peers = [key for key in told if not key.startswith("ours")]
    return {
        f"vs_{peer}_{batch}": told[peer] / told[f"ours_{peer.rpartition('_')[2]}"] for peer in peers
    }


def _training(quick: bool, seeds: Sequence[int]) -> tuple[dict[str, float], dict[str, float]]:
    from benchmarks.lagrangian_peers.training import CONTESTANTS, course

    limit = QUICK_LIMIT_S if quick else LIMIT_S
    target = QUICK_TARGET_NRMSE if quick else TARGET_NRMSE
    figures: dict[str, float] = {"target_nrmse": target}
    told: dict[str, list[float]] = {}
    for seed in seeds:
        courses = {name: course(name, seed, limit, quick=quick) for name in CONTESTANTS}
        for name, found in courses.items():
            label = name if len(seeds) == 1 else f"seed{seed}_{name}"
            figures |= {f"{label}_{key}": value for key, value in found.figures(target).items()}
            if name != "ours":
                told.setdefault(f"time_vs_{name}", []).append(courses["ours"].sooner(found, target))
                own = courses["ours"].sooner(found, min(found.nrmse))
                told.setdefault(f"time_vs_{name}_at_its_best", []).append(own)
    return figures, {key: median(values) for key, values in told.items()}


if __name__ == "__main__":
    print(run())
