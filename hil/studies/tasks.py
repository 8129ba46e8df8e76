"""The independent fits and trainings of a study, spread over processes, longest first."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

from hil.core import FitError, chosen, one_thread, processes, spread
from hil.studies.base import Ended, Progress, tell_ended


def never(result: Any) -> str:
    """Of tasks whose results do not tell of failures."""
    return ""


@dataclass(frozen=True, slots=True)
class Task:
    """Something to compute that can be sent to another process.

    Attributes:
        run: Without arguments; its result is sent back.
        cost: How long it takes compared with the others.
        name: For people, who are told when it is done; nothing is said of tasks without.
        failed: Asked of its result, in this process, what of it failed (`Ended.failed`).
    """

    run: Callable[[], Any]
    cost: float = 1.0
    name: str = ""
    failed: Callable[[Any], str] = never


def run_tasks(
    tasks: Sequence[Task],
    jobs: int,
    what: str,
    progress: Progress,
    executor: Executor | None = None,
) -> list[Any]:
    """Results of the tasks, in their order; they do not depend on where they are computed.

    Args:
        tasks: Independent of each other.
        jobs: Processes of this computer; with 1 nothing leaves this one.
        what: Is being done, for whoever watches.
        progress: Told after every task.
        executor: Takes their place whatever `jobs` is, and stays open; by default that of
            `hil.core.parallel.spread_over`, if there is one around.

    Raises:
        FitError: A process died.
    """
    progress(what, 0, len(tasks))
    given = executor or chosen()
    if not tasks or (given is None and (jobs == 1 or len(tasks) < 2)):
        return _here(tasks, what, progress)
    try:
        return _elsewhere(tasks, given or processes(min(jobs, len(tasks))), given, what, progress)
    except BrokenExecutor as error:
        raise FitError(
            f"a process died while {what}",
            hint="the system may have been out of memory; jobs: 1 needs the least of it",
        ) from error


def _here(tasks: Sequence[Task], what: str, progress: Progress) -> list[Any]:
    results: dict[int, Any] = {}
    news = _News(tasks, what, progress)
    for i, task in enumerate(tasks):
        with one_thread():  # as in the processes, so that results are equal to the bit
            results[i] = _timed(task.run)
        news(results)
    return [result for result, _ in results.values()]


class _News:
    """Tells every task that is done, once, and how many are."""

    def __init__(self, tasks: Sequence[Task], what: str, progress: Progress) -> None:
        self._tasks, self._what, self._progress = tasks, what, progress
        self._told = 0

    def __call__(self, results: Mapping[int, tuple[Any, float]]) -> None:
        total = len(self._tasks)
        for i, (result, seconds) in islice(results.items(), self._told, None):
            self._told += 1
            task = self._tasks[i]
            if task.name:
                ended = Ended(self._told, total, task.name, seconds, task.failed(result))
                tell_ended(self._progress, ended)
        self._progress(self._what, self._told, total)


def _timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """What comes of it, and how long it took [s], wherever it is computed."""
    begin = time.perf_counter()
    return run(), time.perf_counter() - begin


def _elsewhere(
    tasks: Sequence[Task], executor: Executor, given: Executor | None, what: str, progress: Progress
) -> list[Any]:
    try:
        runs = [partial(_timed, task.run) for task in tasks]
        costs = [task.cost for task in tasks]
        results = spread(runs, costs, executor, _News(tasks, what, progress))
    except BaseException:
        if given is None:
            executor.shutdown(wait=False, cancel_futures=True)
        raise
    if given is None:
        executor.shutdown()
    return [result for result, _ in results]
