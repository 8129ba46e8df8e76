"""Where fits run in parallel: a plain `concurrent.futures.Executor` (decision record 0006)."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import Executor, ProcessPoolExecutor

BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processes(workers: int | None = None) -> Executor:
    """Worker processes, one BLAS thread each.

    They are spawned, not forked: a fork after BLAS or torch ran in the parent hangs.

    Args:
        workers: How many; by default one per core.
    """
    return ProcessPoolExecutor(
        max_workers=workers or cores(),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_one_blas_thread,
    )


def _one_blas_thread() -> None:
    """The worker is already importing numpy: limit the loaded libraries, and later ones."""
    from threadpoolctl import threadpool_limits

    for variable in BLAS_VARIABLES:
        os.environ[variable] = "1"
    threadpool_limits(limits=1)
