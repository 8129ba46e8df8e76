"""Fits of a fleet: local processes against a Dask cluster, bit for bit, with a worker killed.

A hundred mock UR5s, each another individual, are recorded (three short trajectories); every one is
fitted by itself by `hil.fleet`, with `rigid-wls`: by one process, by two, by a Dask scheduler with
two worker processes on this computer, and by such a cluster of which one worker is killed (-9) when
half of the fits are done. Times are those of the whole call, processes of this computer being
started in it; a cluster is there before, and its workers import hil in it.
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
        one, one_s = _fitted(runs, workers=1)
        two, two_s = _fitted(runs, workers=2)
        with dask_processes(folder, 2) as (address, _):
            dask, dask_s = _fitted(runs, dask=address)
            again, again_s = _fitted(runs, dask=address)
        with dask_processes(folder, 2) as (address, workers):
            killed, killed_s = _fitted(runs, dask=address, tell=_Kill(workers[0], count // 2))
            deaths = sum(worker.poll() == -9 for worker in workers)
    return {
        "name": "fleet",
        "figures": {
            "robots": count,
            "recording_s": recording_s,
            "recording_mb": size / 1e6,
            "one_process_s": one_s,
            "two_processes_s": two_s,
            "dask_two_workers_s": dask_s,
            "dask_again_s": again_s,
            "dask_one_killed_s": killed_s,
            "workers_killed": deaths,
            "models_two_processes_differ": _differ(one, two),
            "models_dask_differ": _differ(one, dask) + _differ(one, again),
            "models_after_a_kill_differ": _differ(one, killed),
            "models_lost": sum(not found.files for found in (*one, *two, *dask, *killed)),
        },
        "ratios": {
            "two_processes_faster_than_one": one_s / two_s,
            "dask_faster_than_one_process": one_s / dask_s,
            "dask_takes_of_two_processes": dask_s / two_s,
            "dask_again_takes_of_two_processes": again_s / two_s,
            "dask_one_killed_takes_of_dask": killed_s / dask_s,
        },
    }


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
) -> tuple[list[FitResult], float]:
    begin = time.perf_counter()
    found = fit_runs(runs, HOW, workers=workers, dask=dask, tell=tell)
    return found, time.perf_counter() - begin


def _differ(ours: Sequence[FitResult], theirs: Sequence[FitResult]) -> int:
    """How many models are not the same files, bit for bit."""
    pairs = zip(ours, theirs, strict=True)
    return sum(digest_of(one.files) != digest_of(other.files) for one, other in pairs)
