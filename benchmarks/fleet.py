"""Fits of a fleet: local processes against a Dask cluster, bit for bit, with a worker killed.

A hundred mock UR5s, each another individual, are recorded (three short trajectories); every one is
fitted by itself by `hil.fleet`, with `rigid-wls`: by one process, by two, by a Dask scheduler with
two worker processes on this computer, and by such a cluster of which one worker is killed (-9) when
half of the fits are done; all of it twice, the shorter time counts. Times are those of the whole
call, processes of this computer being started in it; a cluster is there before, and its workers
import hil in it (`again` is the same cluster once more).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from subprocess import Popen
from typing import Any

from benchmarks.fleets.dask_processes import dask_processes
from benchmarks.fleets.recorded import ROBOTS, recordings
from hil.executor import processes
from hil.fleet.fit_task import FitResult, How
from hil.fleet.fitting import Tell, fit_runs
from hil.registry.version import digest_of

HOW = How("rigid-wls")
QUICK_ROBOTS = 4
ROUNDS = 2


def run(*, quick: bool = False) -> dict[str, Any]:
    """Record the fleet, fit it four times and compare."""
    count = QUICK_ROBOTS if quick else ROBOTS
    with tempfile.TemporaryDirectory(prefix="hil-fleet-") as name:
        folder = Path(name)
        begin = time.perf_counter()
        with processes(2) as executor:
            runs = recordings(folder, count, executor)
        recording_s = time.perf_counter() - begin
        size = sum(f.stat().st_size for one in runs for f in (one / "recording").iterdir())
        rounds = [_round(folder, runs) for _ in range(1 if quick else ROUNDS)]
    seconds = {key: min(one[key][1] for one in rounds) for key in rounds[0]}
    one_s, two_s, dask_s = (seconds[key] for key in ("one", "two", "dask"))
    first = rounds[0]["one"][0]
    return {
        "name": "fleet",
        "figures": {
            "robots": count,
            "recording_s": recording_s,
            "recording_mb": size / 1e6,
            "one_process_s": one_s,
            "two_processes_s": two_s,
            "dask_two_workers_s": dask_s,
            "dask_again_s": seconds["again"],
            "dask_one_killed_s": seconds["killed"],
            "workers_killed": sum(one["killed"][2] for one in rounds),
            "models_compared": sum(len(made[0]) for one in rounds for made in one.values()),
            "models_that_differ": sum(_differ(first, m[0]) for one in rounds for m in one.values()),
            "models_lost": sum(not f.files for one in rounds for m in one.values() for f in m[0]),
        },
        "ratios": {
            "two_processes_faster_than_one": one_s / two_s,
            "dask_faster_than_one_process": one_s / dask_s,
            "dask_takes_of_two_processes": dask_s / two_s,
            "dask_again_takes_of_two_processes": seconds["again"] / two_s,
            "dask_one_killed_takes_of_dask": seconds["killed"] / dask_s,
        },
    }


Made = tuple[list[FitResult], float, int]
"""Results, seconds, and how many workers were killed."""


def _round(folder: Path, runs: Sequence[Path]) -> dict[str, Made]:
    """Every way once, one after the other, so that what else the computer does meets all alike."""
    made = {"one": _fitted(runs, workers=1), "two": _fitted(runs, workers=2)}
    with dask_processes(folder, 2) as (address, _):
        made["dask"] = _fitted(runs, dask=address)
        made["again"] = _fitted(runs, dask=address)
    with dask_processes(folder, 2) as (address, workers):
        results, seconds, _ = _fitted(runs, dask=address, tell=_Kill(workers[0], len(runs) // 2))
        deaths = sum(worker.poll() == -9 for worker in workers)
    return made | {"killed": (results, seconds, deaths)}


class _Kill:
    """Kills a worker when so many fits are done."""

    def __init__(self, worker: Popen[bytes], at: int) -> None:
        self._worker, self._at = worker, at

    def __call__(self, done: int) -> None:
        if done >= self._at and self._worker.poll() is None:
            self._worker.kill()
            self._worker.wait()


def _fitted(
    runs: Sequence[Path], *, workers: int = 1, dask: str | None = None, tell: Tell = lambda done: 0
) -> Made:
    begin = time.perf_counter()
    found = fit_runs(runs, HOW, workers=workers, dask=dask, tell=tell)
    return found, time.perf_counter() - begin, 0


def _differ(ours: Sequence[FitResult], theirs: Sequence[FitResult]) -> int:
    """How many models are not the same files, bit for bit."""
    pairs = zip(ours, theirs, strict=True)
    return sum(digest_of(one.files) != digest_of(other.files) for one, other in pairs)
