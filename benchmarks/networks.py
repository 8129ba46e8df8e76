"""Networks of the PINN paper and ours, on mock robots whose truth is known and on a real UR10e.

On every mock robot twelve trajectories are followed at 1 kHz; three are judged, and every method is
handed the nine others. The oracle knows all but the sensors' noise. On the UR10e every network
learns from four trajectories and is judged on another one, three times over, beside weighted least
squares and the default. Recordings are not part of the project: without them that part is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from benchmarks.identification import networks_mock, networks_ur10e, recordings
from benchmarks.identification.networks_fits import JOBS
from benchmarks.identification.networks_told import told_of_robots, told_of_ur10e
from benchmarks.identification.table import Section

SEEDS, QUICK_SEEDS = (1, 2), (1,)
"""Of development; the showing is on others."""

QUICK_EFFORT = 0.02
"""Of the usual epochs: nothing is learned, but all of it is done."""

PARTS = ("mock", "ur10e")


def run(
    quick: bool = False,
    seeds: Sequence[int] | None = None,
    effort: float = 1.0,
    jobs: int = JOBS,
    parts: Sequence[str] = PARTS,
) -> dict[str, Any]:
    """Fit, judge, compare.

    Args:
        quick: One small robot, few methods, hardly any training; in this process.
        seeds: Which mock robots instead; the UR10e's networks have seeds of their own.
        effort: Share of the usual epochs that networks are trained for.
        jobs: Processes.
        parts: `mock`, `ur10e` or both.
    """
    if find_spec("torch") is None:
        absent = {"networks": "torch is not installed: pip install 'hil[learn]'"}
        return {"name": "networks", "figures": {}, "ratios": {}, "skipped": absent}
    chosen = tuple(seeds or (QUICK_SEEDS if quick else SEEDS))
    if quick:
        effort, jobs = QUICK_EFFORT, 1
    sections = []
    if "mock" in parts:
        found = networks_mock.contests(chosen, quick=quick, effort=effort, jobs=jobs)
        sections.append(told_of_robots(found))
    if "ur10e" in parts:
        sections.append(_ur10e(quick, effort, jobs))
    document: dict[str, Any] = {"name": "networks"}
    document["tables"] = [table.to_dict() for one in sections for table in one.tables if table.rows]
    for part in ("figures", "ratios", "skipped"):
        document[part] = {
            key: value for section in sections for key, value in getattr(section, part).items()
        }
    return document


def _ur10e(quick: bool, effort: float, jobs: int) -> Section:
    if missing := recordings.missing(networks_ur10e.ARM):
        return Section(skipped={"UR10e": missing})
    return told_of_ur10e(networks_ur10e.scores(quick=quick, effort=effort, jobs=jobs))


if __name__ == "__main__":
    print(run())
