"""Tasks spread over an executor, longest first, whatever happens to a worker."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from typing import Any

from hil.core.dask_cluster import is_lost
from hil.core.errors import FitError
from hil.core.executor import one_thread

TRIES = 3
"""A worker may die of something else than the task it computes."""

LOOK_S = 5.0
"""How often somebody looks whether there are workers left while nothing ends."""

PATIENCE = 6
"""Looks without any worker before it is given up: a worker that died may be started again."""


def spread(
    runs: Sequence[Callable[[], Any]],
    costs: Sequence[float],
    executor: Executor,
    ended: Callable[[Mapping[int, Any]], None],
) -> list[Any]:
    """Results of the runs, in their order.

    Args:
        runs: Independent of each other, and able to travel to another process.
        costs: How long each takes compared with the others; the longest begin first.
        executor: Stays open; after an error or Ctrl-C what has not begun is cancelled.
        ended: Told the results so far by the number of their run, in the order they came.

    Raises:
        FitError: Workers died again and again, or none is left.
        BrokenExecutor: The executor itself is no more.
    """
    order = deque(sorted(range(len(runs)), key=lambda i: -costs[i]))
    going = _Going(runs, executor)
    try:
        while order or going.futures:
            while order and len(going.futures) < getattr(executor, "ahead", len(runs)):
                going.begin(order.popleft())
            order.extendleft(going.take())
            ended(going.results)
    except BaseException:
        for future in going.futures:
            future.cancel()
        raise
    return [going.results[i] for i in range(len(runs))]


class _Going:
    """What is being computed, and what has been."""

    def __init__(self, runs: Sequence[Callable[[], Any]], executor: Executor) -> None:
        self._runs, self._executor = runs, executor
        self._tries = [0] * len(runs)
        self._deserted = 0
        self.futures: dict[Future[Any], int] = {}
        self.results: dict[int, Any] = {}

    def begin(self, i: int) -> None:
        self._tries[i] += 1
        self.futures[self._executor.submit(_run, self._runs[i])] = i

    def take(self) -> list[int]:
        """Wait for the next results; what has to be computed again."""
        ended, _ = wait(self.futures, LOOK_S, FIRST_COMPLETED)
        self._deserted = 0 if ended else self._look()
        # A set has no order: of those that ended together the one that began first is told first.
        begun = [future for future in self.futures if future in ended]
        return [i for i in map(self._lost, begun) if i is not None]

    def _lost(self, future: Future[Any]) -> int | None:
        """Keep a result; which task it is when its worker has gone and it is to begin again."""
        i = self.futures.pop(future)
        try:
            self.results[i] = future.result()
        except (Exception, CancelledError) as error:
            if not (is_lost(error) or isinstance(error, CancelledError)):
                raise
            if self._tries[i] >= TRIES:
                raise FitError(
                    f"{TRIES} workers died one after another of the same task: {error}",
                    hint="they may be out of memory: give each worker fewer threads or more of it",
                ) from error
            return i
        return None

    def _look(self) -> int:
        """So many looks there has been no worker."""
        if getattr(self._executor, "threads", 1):
            return 0
        if self._deserted + 1 >= PATIENCE:
            raise FitError(
                f"no worker has been left for {PATIENCE * LOOK_S:.0f} s",
                hint="start workers again, then make the study again",
            )
        return self._deserted + 1


def _run(run: Callable[[], Any]) -> Any:
    # Ctrl-C reaches the whole group: workers end without a word, the parent says what there is.
    on_main_thread = threading.current_thread() is threading.main_thread()
    if on_main_thread and multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    with one_thread():
        return run()
