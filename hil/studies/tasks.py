"""Parallel execution of the independent fits and trainings of a study, longest tasks first."""

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
    """Return an empty text, as the default failure check for results that contain no failures."""
    return ""


@dataclass(frozen=True, slots=True)
class Task:
    """Computation that can be executed in another process.

    Attributes:
        run: Function without arguments whose result is returned to the main process.
        cost: Expected duration of the task relative to the other tasks.
        name: Display name for progress reports; a task without a name is not reported.
        failed: Function that returns a text about the failures in a result (see `Ended.failed`); it
            runs in the main process.
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
    """Run tasks and return their results in the order of the tasks.

    The results do not depend on the process or computer that executes the tasks.

    Args:
        tasks: Tasks that are independent of each other.
        jobs: Number of processes on this computer; 1 runs all tasks in the current process.
        what: Name of the step in progress reports.
        progress: Progress callback, called after every completed task.
        executor: Executor that is used instead of `jobs` local processes; it is not shut down
            afterwards. The default is the executor of an enclosing `hil.core.parallel.spread_over`,
            if there is one.

    Raises:
        FitError: A worker process died before its task was completed.
    """
    progress(what, 0, len(tasks))
    given = executor or chosen()
    if not tasks or (given is None and (jobs == 1 or len(tasks) < 2)):
        return _here(tasks, what, progress)
    try:
        return _elsewhere(tasks, given or processes(min(jobs, len(tasks))), given, what, progress)
    except BrokenExecutor as error:
        raise FitError(
            f"a process died during: {what}",
            hint="the memory was possibly exhausted; jobs: 1 needs the least memory",
        ) from error


def _here(tasks: Sequence[Task], what: str, progress: Progress) -> list[Any]:
    results: dict[int, Any] = {}
    news = _News(tasks, what, progress)
    for i, task in enumerate(tasks):
        with one_thread():  # as in worker processes, so that results are bit-identical
            results[i] = _timed(task.run)
        news(results)
    return [result for result, _ in results.values()]


class _News:
    """Reporter of completed tasks to a progress callback; each task is reported once."""

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
    """Return the result of a function and its duration [s], measured in the executing process."""
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
