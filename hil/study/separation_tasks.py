"""The independent fits and trainings of a study, spread over processes, longest first."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from threadpoolctl import threadpool_limits

from hil.errors import FitError
from hil.executor import processes
from hil.study.base import Progress


@dataclass(frozen=True, slots=True)
class Task:
    """Something to compute that can be sent to another process.

    Attributes:
        run: Without arguments; its result is sent back.
        cost: How long it takes compared with the others.
    """

    run: Callable[[], Any]
    cost: float = 1.0


def run_tasks(tasks: Sequence[Task], jobs: int, what: str, progress: Progress) -> list[Any]:
    """Results of the tasks, in their order; they do not depend on `jobs`.

    Args:
        tasks: Independent of each other.
        jobs: Processes; with 1 nothing leaves this one.
        what: Is being done, for whoever watches.
        progress: Told after every task.

    Raises:
        FitError: A process died.
    """
    progress(what, 0, len(tasks))
    if jobs == 1 or len(tasks) < 2:
        return _here(tasks, what, progress)
    try:
        return _spread(tasks, min(jobs, len(tasks)), what, progress)
    except BrokenProcessPool as error:
        raise FitError(
            f"a process died while {what}",
            hint="the system may have been out of memory; jobs: 1 needs the least of it",
        ) from error


def _here(tasks: Sequence[Task], what: str, progress: Progress) -> list[Any]:
    results = []
    for task in tasks:
        with threadpool_limits(1):  # as in the processes, so that results are equal to the bit
            results.append(task.run())
        progress(what, len(results), len(tasks))
    return results


def _spread(tasks: Sequence[Task], jobs: int, what: str, progress: Progress) -> list[Any]:
    order = sorted(range(len(tasks)), key=lambda i: -tasks[i].cost)
    with processes(jobs) as pool:
        futures: dict[int, Future[Any]] = {i: pool.submit(_run, tasks[i]) for i in order}
        pending = set(futures.values())
        try:
            while pending:
                ended, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in ended:
                    future.result()
                progress(what, len(tasks) - len(pending), len(tasks))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [futures[i].result() for i in range(len(tasks))]


def _run(task: Task) -> Any:
    # Ctrl-C reaches the whole group: workers end without a word, the parent says what there is.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return task.run()
