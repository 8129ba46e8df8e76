"""Parallel work: independent tasks on any `concurrent.futures.Executor` (decision record 0006).

`processes` are workers of this computer, `cluster` those of a Dask scheduler (extra `fleet`), and
`spread` computes tasks on either, longest first, and again where a worker of a cluster died. A dead
process breaks its whole pool: `spread_over_processes` starts another one. Results do not depend on
the place: workers and the caller alike compute with one thread of BLAS and torch
(`one_thread`), as sums in another order differ in their last bits.
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
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


IMPORTED_FIRST = ("scipy.signal", "scipy.optimize", "pinocchio", "threadpoolctl")
"""What fits import that takes long."""


def process_context(*modules: str) -> Any:
    """Return the context of `multiprocessing` in which worker processes are started.

    They are forked from a server process that has imported modules once for all of them, and in
    which nothing has run: a fork of a process in which BLAS or torch ran can hang. SIGINT is
    blocked in them until they unblock it, and their environment is that of the first call. Where
    the system has no such server they are spawned.

    Args:
        modules: What the server imports beside `IMPORTED_FIRST`, if it is not running yet.
    """
    if not HAS_FORKSERVER:
        return multiprocessing.get_context("spawn")
    multiprocessing.set_forkserver_preload([*IMPORTED_FIRST, *modules])
    resource_tracker.ensure_running()  # whose start unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        with _blas_variables():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return multiprocessing.get_context("forkserver")


def processes(workers: int | None = None) -> Executor:
    """Worker processes, one thread of BLAS and torch each; see `process_context`.

    Args:
        workers: How many; by default one per core.
    """
    return ProcessPoolExecutor(
        max_workers=workers or cores(),
        mp_context=process_context(),
        initializer=_begin_worker,
        initargs=(dict(os.environ),),
    )


def be_worker() -> None:
    """Begin a worker process: it receives Ctrl-C, and ends when its caller is killed.

    It would wait for tasks for ever.
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
    """Take over the environment; limit the loaded libraries to one thread, and later ones."""
    from threadpoolctl import threadpool_limits

    be_worker()
    os.environ.clear()
    os.environ.update(environment, **dict.fromkeys(BLAS_VARIABLES, "1"))
    threadpool_limits(limits=1)


_CHOSEN: ContextVar[Executor | None] = ContextVar("executor", default=None)


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

    with _blas_variables(), threadpool_limits(limits=1), _one_torch_thread():
        yield


@contextlib.contextmanager
def _blas_variables() -> Iterator[None]:
    """The environment asks for one thread."""
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
"""Attempts per task: a worker can die for reasons unrelated to its task."""

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


def spread_over_processes(
    tasks: Sequence[Callable[[], Any]],
    workers: int,
    ended: Callable[[Mapping[int, Any]], None],
    lost: Callable[[int], Any],
) -> list[Any]:
    """Return the results of tasks, in their order, computed by processes of this computer.

    A process that dies ends the others of its pool, whatever they compute. What is missing then is
    computed by a new pool for every few tasks, so that one that kills its process costs few others
    theirs. The last attempt gives each task a process of its own, one after the other: it has all
    the memory, and no other task can end it.

    Args:
        tasks: Independent of each other, and picklable.
        workers: Number of processes.
        ended: Called with the results so far by the number of their task.
        lost: Returns the result of a task whose process has died in every attempt, by its number.
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
                hint="start workers and repeat the command",
            )
        return self._deserted + 1


def _run(run: Callable[[], Any]) -> Any:
    # Ctrl-C reaches the whole group: workers end without a word, the parent says what there is.
    on_main_thread = threading.current_thread() is threading.main_thread()
    if on_main_thread and multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    with one_thread():
        return run()


ADDRESS = re.compile(r"(tcp|tls|ucx|ws|wss)://[^\s:/]+:\d{1,5}")
"""Of a scheduler, as `dask scheduler` prints it."""

CONNECT_S = 10.0
ANSWER_S = 10.0


def checked_address(name: str, value: Any) -> str | None:
    """The address of a scheduler, or None where there is none.

    Args:
        name: Of the parameter, for the error.
        value: What was given.

    Raises:
        SpecError: It is no address.
    """
    if value is None or (isinstance(value, str) and ADDRESS.fullmatch(value)):
        return value
    raise SpecError(
        f"{name} is {value!r}, which is no address of a Dask scheduler",
        hint=f"for example: {name}=tcp://192.168.0.10:8786 (`dask scheduler` prints it)",
    )


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """The cluster at an address for as long as the block lasts; None without an address.

    Raises:
        PluginError: Dask is not installed.
        FitError: No scheduler answers, it has no workers, or theirs is another hil.
    """
    if address is None:
        yield None
        return
    with DaskCluster(address) as executor:
        yield executor


class DaskCluster(Executor):
    """Workers of a Dask scheduler.

    What a task needs is sent to the worker that computes it, and never more than two tasks for
    each thread of a worker: the recordings of a sweep are larger than a scheduler's memory.

    Args:
        address: Of the scheduler, such as `tcp://192.168.0.10:8786`.
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
                hint="start one (`dask scheduler`, then `dask worker ADDRESS`), or leave dask out",
            ) from error
        try:
            self._require_workers()
        except BaseException:
            self._client.close()
            raise
        self._executor = self._client.get_executor(pure=False)

    @property
    def threads(self) -> int:
        """How many tasks the workers compute at once; 0 when none is left."""
        try:
            return sum(self._client.nthreads().values())
        except Exception:  # whatever a scheduler that has gone makes of the question
            return 0

    @property
    def ahead(self) -> int:
        """How many tasks may be under way, so that no worker waits for the next one."""
        return 2 * max(self.threads, 1)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As of any executor; the arguments do not pass through the scheduler."""
        sent = self._scattered(list(args)) if args else []
        future: Future[Any] = self._executor.submit(fn, *sent, **kwargs)
        return future

    def _scattered(self, args: list[Any]) -> Any:
        """Send arguments to a worker, to another one if that dies meanwhile."""
        for attempt in range(1, TRIES + 1):
            try:
                return self._client.scatter(args, hash=False)
            except OSError as error:
                if attempt == TRIES:
                    raise FitError(
                        f"the workers of {self.address} have died {TRIES} times: {error}",
                        hint="see their logs, start workers and repeat the command",
                    ) from error
                self._client.wait_for_workers(1, timeout=CONNECT_S)
        raise AssertionError

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the connection; the cluster goes on. What is not computed yet is given up."""
        with contextlib.suppress(Exception):  # the scheduler may have gone before
            self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close(timeout=ANSWER_S)

    def _require_workers(self) -> None:
        """A worker with another hil would compute something else, or fail after hours."""
        told = self._client.run(importlib.metadata.version, "hil", on_error="return")
        if not told:
            raise FitError(
                f"the Dask scheduler at {self.address} has no workers",
                hint=f"dask worker {self.address}",
            )
        ours = installed()
        for worker, version in told.items():
            if version != ours:
                there = f"hil {version}" if isinstance(version, str) else "no hil"
                raise FitError(
                    f"the Dask worker {worker} has {there}, and here is {ours}",
                    hint="install the same hil on every worker",
                )


def installed() -> str:
    """Version of the hil that is installed here."""
    return importlib.metadata.version("hil")


def is_lost(error: BaseException) -> bool:
    """Whether an error says that a worker has gone, and nothing about what it computed."""
    return type(error).__module__.partition(".")[0] == "distributed"
