"""Fits of a fleet: local processes against a Dask cluster, bit for bit, with a worker killed.

A hundred mock UR5s, each another individual, are recorded (three short trajectories); every one is
fitted by itself with `rigid-wls`: bare, one after another in this process; by one process and by
two; by a Dask scheduler with two worker processes on this computer; on the same cluster again; and
by such a cluster of which one worker is killed (-9) when half of the fits are done. All of it
twice, the shorter time counts, with the processor time of all processes of that round.

What is started counts: processes, or scheduler and workers, with the imports of each, are in the
times of `one`, `two`, `dask` and `killed`, and by themselves `empty_one`, `empty_two` and
`dask_empty`. Nothing is started for `bare` and `dask_again`.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from subprocess import Popen
from typing import Any

from benchmarks.fleets.dask_processes import dask_processes
from benchmarks.fleets.recorded import ROBOTS, recordings
from benchmarks.fleets.timed import Clock, Fits, Took, nothing, timed
from hil.core.parallel import one_thread, processes, spread_over_processes
from hil.models.drift import identity
from hil.models.fleet_fits import FitResult, FitSettings, fit_at, fit_runs
from hil.models.version import digest_of

HOW = FitSettings("rigid-wls")
QUICK_ROBOTS = 4
ROUNDS = 2


def run(*, quick: bool = False) -> dict[str, Any]:
    """Record the fleet, fit it in every way and compare."""
    count, load = QUICK_ROBOTS if quick else ROBOTS, os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="hil-fleet-") as name:
        folder = Path(name)
        begin = time.perf_counter()
        with processes(2) as executor:
            runs = recordings(folder, count, executor)
        recording_s = time.perf_counter() - begin
        size = sum(f.stat().st_size for one in runs for f in (one / "recording").iterdir())
        rounds = [_round(folder, runs) for _ in range(1 if quick else ROUNDS)]
    best = {way: min((one[way] for one in rounds), key=lambda t: t.seconds) for way in rounds[0]}
    took = {way: one.seconds for way, one in best.items()}
    made = [one.fits for each in rounds for one in each.values() if one.fits]
    return {
        "name": "fleet",
        "figures": {
            "robots": count,
            "load_before": load,
            "recording_s": recording_s,
            "recording_mb": size / 1e6,
            **{f"{way}_s": seconds for way, seconds in took.items()},
            **{f"{way}_cpu_s": one.cpu_s for way, one in best.items()},
            "workers_killed": sum(each["killed"].killed for each in rounds),
            "models_compared": sum(map(len, made)),
            "models_that_differ": sum(_differ(made[0], fits) for fits in made),
            "models_lost": sum(not one.files for fits in made for one in fits),
        },
        "ratios": {
            "two_processes_faster_than_one": took["one"] / took["two"],
            "dask_faster_than_one_process": took["one"] / took["dask"],
            "dask_takes_of_two_processes": took["dask"] / took["two"],
            "dask_again_takes_of_bare": took["dask_again"] / took["bare"],
            "dask_one_killed_takes_of_dask": took["killed"] / took["dask"],
        },
    }


def _round(folder: Path, runs: Sequence[Path]) -> dict[str, Took]:
    """Every way once, one after the other, so that what else the computer does meets all alike."""
    nothing()
    made = {
        "bare": timed(lambda: _bare(runs)),
        "empty_one": timed(lambda: _empty(1)),
        "one": timed(lambda: fit_runs(runs, HOW, workers=1)),
        "empty_two": timed(lambda: _empty(2)),
        "two": timed(lambda: fit_runs(runs, HOW, workers=2)),
    }
    clock = Clock()
    with dask_processes(folder, 2) as (address, cluster):
        fits = fit_runs(runs, HOW, workers=1, dask=address)
        made["dask"] = clock.took(fits, cluster)
        made["dask_again"] = timed(lambda: fit_runs(runs, HOW, workers=1, dask=address), cluster)
    clock = Clock()
    with dask_processes(folder, 2) as (address, cluster):
        _import_there(address)
        made["dask_empty"] = clock.took((), cluster)
        kill = _Kill(cluster[0], len(runs) // 2)
        fits = fit_runs(runs, HOW, workers=1, dask=address, on_progress=kill)
        deaths = sum(process.poll() == -9 for process in cluster)
        made["killed"] = clock.took(fits, cluster, deaths)
    return made


def _bare(runs: Sequence[Path]) -> Fits:
    with one_thread():
        found = [fit_at(run, identity(run)[0], HOW) for run in runs]
    return [one for one in found if one is not None]


def _empty(workers: int) -> Fits:
    spread_over_processes([nothing] * workers, workers, lambda results: None, lambda i: None)
    return ()


def _import_there(address: str) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.run(nothing)


class _Kill:
    """Kills a worker when so many fits are done."""

    def __init__(self, worker: Popen[bytes], at: int) -> None:
        self._worker, self._at = worker, at

    def __call__(self, done: int) -> None:
        if done >= self._at and self._worker.poll() is None:
            self._worker.kill()
            self._worker.wait()


def _differ(ours: Sequence[FitResult], theirs: Sequence[FitResult]) -> int:
    """How many models are not the same files, bit for bit."""
    pairs = zip(ours, theirs, strict=True)
    return sum(digest_of(one.files) != digest_of(other.files) for one, other in pairs)
