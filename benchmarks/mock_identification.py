"""Dynamic identification on mock robots, whose truth is known: intervals, bias, and what is left.

Three parts. `ideal` robots have the form of the classical model: do 95 % intervals hold the true
parameters? On `full` robots, what do such intervals hold, and how far are they off? And of what the
best classical method leaves unexplained on trajectories it has not seen, how much does the default
explain, the oracle being the noise alone? Physics is MuJoCo's and the friction the mock's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.identification.mock_coverage import all_estimated, figures
from benchmarks.identification.mock_gap import Contest, contests

SEEDS, QUICK_SEEDS = (1, 2, 3), (1,)
"""Of development; `tests/proofs/test_identification.py` judges on others."""

JOBS = 2


def run(quick: bool = False, seeds: Sequence[int] | None = None) -> dict[str, Any]:
    """Simulate, fit and judge.

    Args:
        quick: One seed, a few trajectories, two methods.
        seeds: Which robots instead.
    """
    chosen = tuple(seeds or (QUICK_SEEDS if quick else SEEDS))
    jobs = 1 if quick else JOBS
    told: dict[str, float] = {}
    for profile in ("ideal", "full"):
        found = figures(all_estimated(chosen, jobs, profile=profile))
        told |= {f"{profile}_{key}": value for key, value in found.items()}
    judged = contests(chosen, jobs, quick=quick)
    for contest in judged:
        told |= {f"seed{contest.seed}_{key}": value for key, value in errors(contest).items()}
    shares = [one.share_of_gap(one.filtered) for one in judged]
    ratios = {f"seed{one.seed}_share_of_gap": s for one, s in zip(judged, shares, strict=True)}
    ratios["worst_share_of_gap_to_oracle"] = min(shares)
    return {"name": "mock_identification", "figures": told, "ratios": ratios}


def errors(contest: Contest) -> dict[str, float]:
    """Errors of every method [N·m], CPU seconds, and the least relative eigenvalue of M(q)."""
    return (
        {f"{name}_rmse_nm": error for name, error in contest.filtered.items()}
        | {f"{name}_raw_rmse_nm": error for name, error in contest.raw.items()}
        | {f"{name}_cpu_s": seconds for name, seconds in contest.seconds.items()}
        | {f"{name}_least_inertia": value for name, value in contest.least_inertia.items()}
    )


if __name__ == "__main__":
    print(run())
