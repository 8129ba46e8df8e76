"""Networks trained one after the other, spread over processes, or as one batch on a GPU.

Worker processes come from `forkserver` (or `spawn` where there is none): a fork of a process that
has used BLAS can hang.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import FloatArray
from hil.estimators import whole
from hil.networks.lm.network import Mlp
from hil.networks.lm.rows import Rows
from hil.networks.lm.scaling import Scaling
from hil.networks.lm.settings import Settings
from hil.networks.lm.trained import Callback, Epoch, History
from hil.networks.lm.training import Training

POLL_S = 0.05
"""How often the epochs that workers report are passed on."""

Result = tuple[FloatArray, tuple[History, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Networks to train together."""

    mlp: Mlp
    rows: Rows
    validation: Rows | None
    scaling: Scaling
    start: FloatArray
    settings: Settings
    first: int = 0

    def single(self, network: int) -> Task:
        """The task of one network alone."""
        validation = self.validation and self.validation.single(network)
        start = self.start[network : network + 1]
        return Task(
            self.mlp, self.rows.single(network), validation, self.scaling.single(network), start,
            self.settings, network,
        )  # fmt: skip

    def run(self, callback: Callback | None = None) -> Result:
        """Train, on one thread of BLAS."""
        with threadpool_limits(1):
            training = Training(
                self.mlp, self.rows, self.validation, self.scaling, self.start, self.settings,
                self.first,
            )  # fmt: skip
            return training.run(callback)


def run_all(task: Task, *, jobs: int, callback: Callback | None) -> Result:
    """Train all networks of a task.

    Raises:
        SpecError: `jobs` is not a positive whole number.
    """
    whole("jobs", jobs, at_least=1)
    if task.settings.device != "cpu":
        return task.run(callback)
    alone = [task.single(network) for network in range(task.rows.networks)]
    if jobs == 1 or len(alone) == 1:
        return _joined([one.run(callback) for one in alone])
    return _joined(_spread(alone, min(jobs, len(alone)), callback))


def _joined(results: list[Result]) -> Result:
    weights = np.concatenate([weights for weights, _ in results])
    return weights, tuple(history for _, histories in results for history in histories)


def _spread(tasks: list[Task], jobs: int, callback: Callback | None) -> list[Result]:
    known = multiprocessing.get_all_start_methods()
    context: Any = multiprocessing.get_context("forkserver" if "forkserver" in known else "spawn")
    reports, ended = context.SimpleQueue(), context.Event()
    wanted = callback is not None
    with ProcessPoolExecutor(jobs, context, _open, (reports, ended, wanted)) as pool:
        futures = [pool.submit(_run, task) for task in tasks]
        try:
            _follow(futures, reports, callback)
        except BaseException:
            # Workers that report into a full pipe would wait for ever: read on until they end.
            ended.set()
            for future in futures:
                future.cancel()
            _follow(futures, reports, None)
            raise
    return [future.result() for future in futures]


def _follow(futures: list[Future[Result]], reports: Any, callback: Callback | None) -> None:
    pending = set(futures)
    while pending:
        _, pending = wait(pending, timeout=POLL_S)
        while not reports.empty():
            epoch = reports.get()
            if callback is not None:
                callback(epoch)


class _Ended(Exception):
    """The parent does not want the result any more."""


_report: Callable[[Epoch], None] | None = None
"""In a worker: passes an epoch on."""


def _open(reports: Any, ended: Any, wanted: bool) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def report(epoch: Epoch) -> None:
        if ended.is_set():
            raise _Ended
        if wanted:
            reports.put(epoch)

    global _report
    _report = report


def _end_with_parent() -> None:
    """A parent that was killed can stop nobody, and its workers would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run(task: Task) -> Result:
    return task.run(_report)
