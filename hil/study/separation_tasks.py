"""The independent fits and trainings of a study, spread over processes, longest first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass
from typing import Any

from hil.errors import FitError
from hil.executor import chosen, one_thread, processes
from hil.study.base import Progress
from hil.study.spreading import spread


@dataclass(frozen=True, slots=True)
class Task:
    """Something to compute that can be sent to another process.

    Attributes:
        run: Without arguments; its result is sent back.
        cost: How long it takes compared with the others.
    """

    run: Callable[[], Any]
    cost: float = 1.0


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
            `hil.executor.spread_over`, if there is one around.

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
    results = []
    for task in tasks:
        with one_thread():  # as in the processes, so that results are equal to the bit
            results.append(task.run())
        progress(what, len(results), len(tasks))
    return results


def _elsewhere(
    tasks: Sequence[Task], executor: Executor, given: Executor | None, what: str, progress: Progress
) -> list[Any]:
    try:
        runs, costs = [task.run for task in tasks], [task.cost for task in tasks]
        results = spread(runs, costs, executor, lambda done: progress(what, done, len(tasks)))
    except BaseException:
        if given is None:
            executor.shutdown(wait=False, cancel_futures=True)
        raise
    if given is None:
        executor.shutdown()
    return results
