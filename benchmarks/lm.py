"""Levenberg–Marquardt for a network of 741 weights on 6,500 rows: ours, pyrenn's and torch's.

Everybody fits the same rows from the same start: 650 poses of ten samples, a smooth function of
four joint angles and noise. pyrenn goes first, for `ITERATIONS` or until its time is over; what
counts is the CPU time until the RMSE on all rows that pyrenn ended with. Each contestant has a
process of its own and one BLAS thread; `peak_mib` is memory beyond imports and rows.

pyrenn and torch are optional: whoever is missing is left out, and `skipped` says why.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from hil.core.errors import FitError

POSES, QUICK_POSES = 650, 60
ITERATIONS, QUICK_ITERATIONS = 100, 5
SAMPLES = 10
NOISE_A = 0.005
LIMIT_S = 900.0
PEERS = {"pyrenn": "with_pyrenn", "torch_vmap_jacrev": "with_torch"}
OURS = {"ours_averaged": "averaged", "ours_plain": "plain"}
"""Programs in `benchmarks/lm_peers`."""

_ROOT = Path(__file__).resolve().parent.parent


@dataclass
class Course:
    """How a contestant fared.

    Attributes:
        cpu_s: CPU time from the start of the training to the end of each epoch, the start first.
        rmse: On all rows then [A].
        peak_mib: Memory beyond what was in use before the training.
        skipped: Why there is nothing to tell; empty otherwise.
    """

    cpu_s: list[float] = field(default_factory=list)
    rmse: list[float] = field(default_factory=list)
    peak_mib: float = 0.0
    skipped: str = ""

    def until(self, rmse: float) -> float:
        """CPU seconds until that RMSE; infinite when it was not reached."""
        reached = [t for t, value in zip(self.cpu_s, self.rmse, strict=True) if value <= rmse]
        return reached[0] if reached else float("inf")

    @property
    def epochs(self) -> int:
        """Epochs done."""
        return len(self.cpu_s) - 1

    @property
    def ms_per_epoch(self) -> float:
        """CPU time."""
        return 1e3 * (self.cpu_s[-1] - self.cpu_s[0]) / max(self.epochs, 1)


def run(
    quick: bool = False, iterations: int = 0, seeds: Sequence[int] | None = None
) -> dict[str, Any]:
    """CPU time to pyrenn's final RMSE, CPU time per epoch and peak memory of everybody.

    Args:
        quick: Fewer rows and epochs.
        iterations: Of pyrenn.
        seeds: Of rows and start weights; 0 alone by default, for pyrenn takes minutes. With several
            everything is told by seed, and the ratios' medians beside.
    """
    chosen = tuple(dict.fromkeys(seeds or (0,)))
    if len(chosen) == 1:
        return {"name": "lm", **_of_seed(quick, iterations, chosen[0])}
    told = {seed: _of_seed(quick, iterations, seed) for seed in chosen}
    figures, ratios = (
        {
            f"seed{seed}_{key}": value
            for seed, one in told.items()
            for key, value in one[part].items()
        }
        for part in ("figures", "ratios")
    )
    for key in told[chosen[0]]["ratios"]:
        ratios[f"median_{key}"] = median(one["ratios"][key] for one in told.values())
    return {
        "name": "lm", "figures": figures, "ratios": ratios, "skipped": told[chosen[0]]["skipped"]
    }  # fmt: skip


def _of_seed(quick: bool, iterations: int, seed: int) -> dict[str, Any]:
    poses = QUICK_POSES if quick else POSES
    wanted = iterations or (QUICK_ITERATIONS if quick else ITERATIONS)
    courses = {"pyrenn": _course("pyrenn", poses, seed, wanted)}
    # Without pyrenn: an RMSE a little above the noise, which is the floor of any fit.
    target = 1.1 * NOISE_A if courses["pyrenn"].skipped else min(courses["pyrenn"].rmse)
    for name in (*OURS, "torch_vmap_jacrev"):
        courses[name] = _course(name, poses, seed, 1000, target)
    figures: dict[str, float] = {"rows": SAMPLES * poses, "target_rmse_a": target}
    for name, course in courses.items():
        figures |= _figures(name, course, target)
    skipped = {name: course.skipped for name, course in courses.items() if course.skipped}
    ratios = _ratios(courses, target)
    return {"figures": figures, "ratios": ratios, "skipped": skipped}


def _figures(name: str, course: Course, target: float) -> dict[str, float]:
    if course.skipped:
        return {}
    return {
        f"{name}_cpu_s": course.until(target),
        f"{name}_epochs": course.epochs,
        f"{name}_ms_per_epoch": course.ms_per_epoch,
        f"{name}_peak_mib": course.peak_mib,
    }


def _ratios(courses: dict[str, Course], target: float) -> dict[str, float]:
    """How many times sooner ours is at the target."""
    return {
        f"{ours}_vs_{peer}": courses[peer].until(target) / courses[ours].until(target)
        for peer in PEERS
        if not courses[peer].skipped
        for ours in OURS
    }


def _course(name: str, poses: int, seed: int, iterations: int, target: float = 0.0) -> Course:
    """Let a contestant run in a process of its own."""
    terms = [str(value) for value in (poses, seed, iterations, LIMIT_S, target)]
    told = subprocess.run(
        [sys.executable, "-m", f"benchmarks.lm_peers.{(OURS | PEERS)[name]}", *terms],
        cwd=_ROOT,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if told.returncode:
        raise FitError(f"{name} failed in the benchmark lm (exit code {told.returncode})")
    return Course(**json.loads(told.stdout.splitlines()[-1]))


if __name__ == "__main__":
    print(run())
