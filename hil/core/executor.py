"""Where fits run in parallel: a plain `concurrent.futures.Executor` (decision record 0006)."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextvars import ContextVar

BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_CHOSEN: ContextVar[Executor | None] = ContextVar("executor", default=None)


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processes(workers: int | None = None) -> Executor:
    """Worker processes, one thread of BLAS and torch each.

    They are spawned, not forked: a fork after BLAS or torch ran in the parent hangs.

    Args:
        workers: How many; by default one per core.
    """
    return ProcessPoolExecutor(
        max_workers=workers or cores(),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_one_blas_thread,
    )


@contextlib.contextmanager
def spread_over(executor: Executor | None) -> Iterator[None]:
    """Whatever is spread over processes inside this block is spread over `executor` instead.

    Args:
        executor: Stays open; what it runs must be able to import hil. None changes nothing.
    """
    token = _CHOSEN.set(executor or _CHOSEN.get())
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def chosen() -> Executor | None:
    """The executor of the innermost `spread_over`; None for processes of this computer."""
    return _CHOSEN.get()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS and torch keep to one thread, so that results are the same bits wherever they are made.

    A torch that is imported inside the block keeps to it, too: it asks the environment.
    """
    from threadpoolctl import threadpool_limits

    before = {name: os.environ.get(name) for name in BLAS_VARIABLES}
    os.environ.update(dict.fromkeys(BLAS_VARIABLES, "1"))
    try:
        with threadpool_limits(limits=1), _one_torch_thread():
            yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({name: value} if value is not None else {})


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _one_blas_thread() -> None:
    """The worker is already importing numpy: limit the loaded libraries, and later ones."""
    from threadpoolctl import threadpool_limits

    for variable in BLAS_VARIABLES:
        os.environ[variable] = "1"
    threadpool_limits(limits=1)
