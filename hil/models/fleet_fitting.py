"""Fits of a fleet, on processes of this computer or a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from functools import partial
from pathlib import Path
from typing import Any

from hil.core import TRIES, DataError, FitError, cluster, processes, spread
from hil.models.drift.history import identity
from hil.models.fleet_fit_task import FitResult, How, Sent, fit_at

Tell = Callable[[int], object]
"""Told how many are done."""


def fit_runs(
    runs: Sequence[Path],
    how: How,
    *,
    workers: int,
    dask: str | None = None,
    tell: Tell = lambda done: None,
) -> list[FitResult]:
    """Fit every run by itself, in their order; equal to the bit wherever they are fitted.

    A run that cannot be fitted leaves the others alone: its result says why.

    Args:
        runs: Their directories.
        how: What to fit.
        workers: Processes of this computer.
        dask: Scheduler whose workers take their place.
        tell: Told how many are done.

    Raises:
        FitError: Workers died again and again, or none is left.
        PluginError: Dask is not installed.
    """
    paths = [run.resolve() for run in runs]
    tasks = [_task(run, how) for run in paths]
    with cluster(dask) as executor:
        found = computed(tasks, workers, executor, tell)
        unseen = [i for i, one in enumerate(found) if one is None]
        sent = [Sent(paths[i], how) for i in unseen]
        more = computed(sent, workers, executor, lambda done: tell(len(runs) - len(sent) + done))
        for i, one in zip(unseen, more, strict=True):
            found[i] = one
    return found


def _task(run: Path, how: How) -> Callable[[], FitResult | None]:
    try:
        return partial(fit_at, run, identity(run)[0], how)
    except DataError as error:  # deleted since: the others are still there
        return partial(FitResult, error=error.message)


def computed(
    tasks: Sequence[Callable[[], Any]], workers: int, executor: Executor | None, tell: Tell
) -> list[Any]:
    """Results of tasks, in their order; what dies with its process is computed again.

    Args:
        tasks: Independent of each other, and able to travel to another process.
        workers: Processes of this computer.
        executor: Takes their place, and stays open.
        tell: Told how many are done.

    Raises:
        FitError: Workers died again and again.
    """
    costs = [1.0] * len(tasks)
    found: dict[int, Any] = {}

    def news(results: Mapping[int, Any]) -> None:
        tell(len(results))

    if executor is not None:
        return spread(tasks, costs, executor, news)
    for _ in range(TRIES):
        left = [i for i in range(len(tasks)) if i not in found]
        if not left:
            break
        _on_processes([tasks[i] for i in left], left, workers, found, tell)
    if len(found) < len(tasks):
        raise FitError(
            f"{TRIES} times a process died while fitting",
            hint="they may be out of memory: --workers 1 needs the least of it",
        )
    return [found[i] for i in range(len(tasks))]


def _on_processes(
    tasks: Sequence[Callable[[], Any]],
    numbers: Sequence[int],
    workers: int,
    found: dict[int, Any],
    tell: Tell,
) -> None:
    """Compute tasks until all are done or a process dies, which ends the others of its pool."""

    def keep(results: Mapping[int, Any]) -> None:
        found.update({numbers[i]: result for i, result in results.items()})
        tell(len(found))

    pool = processes(min(workers, len(tasks)))
    try:
        spread(tasks, [1.0] * len(tasks), pool, keep)
    except BrokenExecutor:
        pool.shutdown(wait=True, cancel_futures=True)
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    else:
        pool.shutdown()
