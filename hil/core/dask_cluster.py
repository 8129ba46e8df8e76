"""A Dask cluster as a `concurrent.futures.Executor`: fits on other computers (extra `fleet`)."""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import Any

from hil.core import plugins
from hil.core.errors import FitError, SpecError

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
        sent = self._client.scatter(list(args), hash=False) if args else []
        future: Future[Any] = self._executor.submit(fn, *sent, **kwargs)
        return future

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
