"""Parallel execution of independent tasks on `concurrent.futures` executors (decision record 0006).

The function `processes` starts worker processes on this computer, and `cluster` connects to the
workers of a Dask scheduler (extra `fleet`). The function `spread` computes tasks on either kind of
executor, longest task first, and repeats tasks of a cluster worker that died. A process that dies
breaks its whole pool of processes, so `spread_over_processes` starts a new pool. The results do not
depend on the computer that computes them: workers and caller use one thread for BLAS and torch
(`one_thread`), because sums in a different order differ in their last bits.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import multiprocessing
import os
import re
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextvars import ContextVar
from typing import Any

from hil.core import plugins
from hil.core.errors import FitError, SpecError

HAS_FORKSERVER = "forkserver" in multiprocessing.get_all_start_methods()
if HAS_FORKSERVER:
    from multiprocessing import forkserver, resource_tracker

BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


IMPORTED_FIRST = ("scipy.signal", "scipy.optimize", "pinocchio", "threadpoolctl")
"""Names of modules that fits need and that take long to import."""


def process_context(*modules: str) -> Any:
    """Return the `multiprocessing` context in which worker processes are started.

    Workers are forked from a server process that has imported the modules a single time for all
    workers and has not computed anything. In contrast, a process that is forked from a process that
    has used BLAS or torch can hang. In a worker, SIGINT is blocked until the worker unblocks it,
    and the environment variables are those of the first call. If the operating system does not
    support a fork server, workers are spawned.

    Args:
        modules: Names of modules that the server imports in addition to `IMPORTED_FIRST`, if the
            server is not running yet.
    """
    if not HAS_FORKSERVER:
        return multiprocessing.get_context("spawn")
    multiprocessing.set_forkserver_preload([*IMPORTED_FIRST, *modules])
    resource_tracker.ensure_running()  # before blocking SIGINT: starting the tracker unblocks it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        with _blas_variables():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return multiprocessing.get_context("forkserver")


def processes(workers: int | None = None) -> Executor:
    """Return an executor with worker processes that use one thread each for BLAS and torch.

    The function `process_context` describes how the worker processes are started.

    Args:
        workers: Number of worker processes; by default one per core.
    """
    return ProcessPoolExecutor(
        max_workers=workers or cores(),
        mp_context=process_context(),
        initializer=_begin_worker,
        initargs=(dict(os.environ),),
    )


def be_worker() -> None:
    """Set up a worker process: receive Ctrl-C, and end if the parent process is killed.

    Without this setup, an orphaned worker would wait for tasks forever.
    """
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])

    def wait_for_parent() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def _begin_worker(environment: Mapping[str, str]) -> None:
    """Apply the environment of the parent, and limit present and later libraries to one thread."""
    from threadpoolctl import threadpool_limits

    be_worker()
    os.environ.clear()
    os.environ.update(environment, **dict.fromkeys(BLAS_VARIABLES, "1"))
    threadpool_limits(limits=1)


_CHOSEN: ContextVar[Executor | None] = ContextVar("executor", default=None)


@contextlib.contextmanager
def spread_over(executor: Executor | None) -> Iterator[None]:
    """Use `executor` within the context for all tasks that would otherwise use worker processes.

    Args:
        executor: Executor whose workers can import hil; it is not closed; None has no effect.
    """
    token = _CHOSEN.set(executor or _CHOSEN.get())
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def chosen() -> Executor | None:
    """Return the executor of the innermost `spread_over`; None if processes are to be used."""
    return _CHOSEN.get()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS and torch to one thread within the context, for bit-identical results everywhere.

    If torch is imported within the context, torch is limited, too, because it reads the environment
    variables.
    """
    from threadpoolctl import threadpool_limits

    with _blas_variables(), threadpool_limits(limits=1), _one_torch_thread():
        yield


@contextlib.contextmanager
def _blas_variables() -> Iterator[None]:
    """Set the environment variables that limit libraries to one thread, within the context."""
    before = {name: os.environ.get(name) for name in BLAS_VARIABLES}
    os.environ.update(dict.fromkeys(BLAS_VARIABLES, "1"))
    try:
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


TRIES = 3
"""Maximum number of attempts per task; a worker can die for reasons unrelated to its task."""

LOOK_S = 5.0
"""Time between two checks for remaining workers while no task ends [s]."""

PATIENCE = 6
"""Number of checks without any worker before giving up, because a dead worker may be restarted."""


def spread(
    runs: Sequence[Callable[[], Any]],
    costs: Sequence[float],
    executor: Executor,
    ended: Callable[[Mapping[int, Any]], None],
) -> list[Any]:
    """Return the results of independent functions, in the order of the functions.

    Args:
        runs: Independent functions that can be sent to a different process.
        costs: Relative durations of the functions; the longest begin first.
        executor: Executor for the functions, which is not closed; after an error or Ctrl-C, pending
            tasks are cancelled.
        ended: Callback that receives all results so far, by index of the function, in order of
            completion.

    Raises:
        FitError: Workers died repeatedly, or no worker is left.
        BrokenExecutor: The executor cannot accept further tasks.
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


def spread_over_processes(
    tasks: Sequence[Callable[[], Any]],
    workers: int,
    ended: Callable[[Mapping[int, Any]], None],
    lost: Callable[[int], Any],
) -> list[Any]:
    """Return the results of tasks, in their order, computed by processes of this computer.

    If a worker process dies, the other processes of its pool also end. The missing results are
    computed by new pools, each for a few tasks, so that a task that kills its process affects few
    other tasks. The last attempt computes each remaining task in a separate process, one task after
    the other, so that each task has all the memory and no other task can end its process.

    Args:
        tasks: Independent functions that can be pickled.
        workers: Number of worker processes.
        ended: Callback that receives all results so far, by index of the task.
        lost: Function that returns a replacement result for the index of a task whose process died
            in every attempt.
    """
    results: dict[int, Any] = {}

    def compute(numbers: Sequence[int]) -> None:
        """Compute tasks until all are done or the pool breaks because a process died."""

        def keep(new: Mapping[int, Any]) -> None:
            results.update({numbers[i]: result for i, result in new.items()})
            ended(results)

        pool = processes(min(workers, len(numbers)))
        try:
            spread([tasks[i] for i in numbers], [1.0] * len(numbers), pool, keep)
        except BrokenExecutor:
            pool.shutdown(wait=True, cancel_futures=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        else:
            pool.shutdown()

    for attempt in range(1, TRIES + 1):
        missing = [i for i in range(len(tasks)) if i not in results]
        size = {1: max(len(tasks), 1), TRIES: 1}.get(attempt, workers)
        for first in range(0, len(missing), size):
            compute(missing[first : first + size])
    return [results[i] if i in results else lost(i) for i in range(len(tasks))]


class _Going:
    """Running and completed tasks during one call of `spread`."""

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
        """Wait for the next results; return the indices of tasks to repeat."""
        ended, _ = wait(self.futures, LOOK_S, FIRST_COMPLETED)
        self._deserted = 0 if ended else self._look()
        # A set is unordered: futures that ended together are handled in the order of submission.
        begun = [future for future in self.futures if future in ended]
        return [i for i in map(self._lost, begun) if i is not None]

    def _lost(self, future: Future[Any]) -> int | None:
        """Store the result of a task; return the index of the task only if it must be repeated.

        A task must be repeated if the worker that computed it was lost.
        """
        i = self.futures.pop(future)
        try:
            self.results[i] = future.result()
        except (Exception, CancelledError) as error:
            if not (is_lost(error) or isinstance(error, CancelledError)):
                raise
            if self._tries[i] >= TRIES:
                raise FitError(
                    f"{TRIES} workers in succession died while computing the same task: {error}",
                    hint="if the workers run out of memory, give each fewer threads or more memory",
                ) from error
            return i
        return None

    def _look(self) -> int:
        """Return the number of consecutive checks that detected no worker."""
        if getattr(self._executor, "threads", 1):
            return 0
        if self._deserted + 1 >= PATIENCE:
            raise FitError(
                f"no worker has been available for {PATIENCE * LOOK_S:.0f} s",
                hint="start workers and repeat the command",
            )
        return self._deserted + 1


def _run(run: Callable[[], Any]) -> Any:
    # Ctrl-C reaches the whole process group: workers end silently, and the parent reports it.
    on_main_thread = threading.current_thread() is threading.main_thread()
    if on_main_thread and multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    with one_thread():
        return run()


ADDRESS = re.compile(r"(tcp|tls|ucx|ws|wss)://[^\s:/]+:\d{1,5}")
"""Pattern of the address of a Dask scheduler, as printed by `dask scheduler`."""

CONNECT_S = 10.0
ANSWER_S = 10.0


def checked_address(name: str, value: Any) -> str | None:
    """Return the address of a Dask scheduler; None if no address was passed.

    Args:
        name: Name of the parameter that contains the address, for the error message.
        value: Value of the parameter that contains the address.

    Raises:
        SpecError: The value is not the address of a scheduler.
    """
    if value is None or (isinstance(value, str) and ADDRESS.fullmatch(value)):
        return value
    raise SpecError(
        f"{name} is {value!r}, which is not the address of a Dask scheduler",
        hint=f"for example: {name}=tcp://192.168.0.10:8786 (`dask scheduler` prints it)",
    )


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """Connect to the cluster at an address within the context; yield None without an address.

    Raises:
        PluginError: The library Dask is not installed.
        FitError: No scheduler responds, the scheduler has no workers, or the workers have a
            different version of hil.
    """
    if address is None:
        yield None
        return
    with DaskCluster(address) as executor:
        yield executor


class DaskCluster(Executor):
    """Executor that computes tasks on the workers of a Dask scheduler.

    The data of a task are sent directly to the worker that computes the task, for at most two tasks
    per thread of a worker at a time, because the recordings of a sweep exceed the memory of a
    scheduler.

    Args:
        address: Address of the Dask scheduler, such as `tcp://192.168.0.10:8786`.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise plugins.not_installed("a Dask cluster", ["distributed"], "fleet") from error
        self.address = address
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise FitError(
                f"no Dask scheduler answers at {address}: {error}",
                hint="start one (`dask scheduler`, then `dask worker ADDRESS`), or omit `dask`",
            ) from error
        try:
            self._require_workers()
        except BaseException:
            self._client.close()
            raise
        self._executor = self._client.get_executor(pure=False)

    @property
    def threads(self) -> int:
        """Number of tasks that the workers can compute at the same time; 0 if no worker is left."""
        try:
            return sum(self._client.nthreads().values())
        except Exception:  # a lost scheduler may cause any error
            return 0

    @property
    def ahead(self) -> int:
        """Maximum number of submitted tasks, chosen so that no worker waits for its next task."""
        return 2 * max(self.threads, 1)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task; the arguments of the task do not pass through the scheduler."""
        sent = self._scattered(list(args)) if args else []
        future: Future[Any] = self._executor.submit(fn, *sent, **kwargs)
        return future

    def _scattered(self, args: list[Any]) -> Any:
        """Send arguments to a worker; send them to a different worker if the worker dies."""
        for attempt in range(1, TRIES + 1):
            try:
                return self._client.scatter(args, hash=False)
            except OSError as error:
                if attempt == TRIES:
                    raise FitError(
                        f"the workers of {self.address} have died {TRIES} times: {error}",
                        hint="check their logs, start workers and repeat the command",
                    ) from error
                self._client.wait_for_workers(1, timeout=CONNECT_S)
        raise AssertionError

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the connection and drop unfinished tasks; the cluster keeps running."""
        with contextlib.suppress(Exception):  # the scheduler may be lost already
            self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close(timeout=ANSWER_S)

    def _require_workers(self) -> None:
        """Raise if the cluster has no workers, or if a worker has a different version of hil.

        A worker with a different version of hil could compute different results, or fail after
        hours.
        """
        versions = self._client.run(importlib.metadata.version, "hil", on_error="return")
        if not versions:
            raise FitError(
                f"the Dask scheduler at {self.address} has no workers",
                hint=f"dask worker {self.address}",
            )
        ours = installed()
        for worker, version in versions.items():
            if version != ours:
                there = f"hil {version}" if isinstance(version, str) else "no hil"
                raise FitError(
                    f"the Dask worker {worker} has {there}, but this computer has hil {ours}",
                    hint="install the same version of hil on every worker",
                )


def installed() -> str:
    """Return the version of the installed package hil."""
    return importlib.metadata.version("hil")


def is_lost(error: BaseException) -> bool:
    """Return whether an error means that a worker was lost, instead of an error of its task."""
    return type(error).__module__.partition(".")[0] == "distributed"
