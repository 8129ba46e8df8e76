"""A Dask scheduler and its workers as processes of their own, which can be killed."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from hil.core.parallel import BLAS_VARIABLES

PATIENCE_S = 60.0


@contextlib.contextmanager
def dask_processes(
    folder: Path, workers: int
) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a scheduler on 127.0.0.1; its workers with one thread each, and itself as last.

    Nobody starts a worker again that has died.

    Args:
        folder: For what the processes write.
        workers: How many.
    """
    found = folder / "scheduler.json"
    found.unlink(missing_ok=True)
    common = ["--scheduler-file", str(found), "--no-dashboard"]
    scheduler = _started("dask_scheduler", *common, "--host", "127.0.0.1", "--port", "0")
    each = [*common, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny"]
    started = [
        _started("dask_worker", *each, "--local-directory", str(folder)) for _ in range(workers)
    ]
    try:
        yield _address(found, scheduler, workers), [*started, scheduler]
    finally:
        for process in (*started, scheduler):
            process.terminate()
        for process in (*started, scheduler):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
            process.wait()


def _started(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env=os.environ | dict.fromkeys(BLAS_VARIABLES, "1"),
    )  # fmt: skip


def _address(file: Path, scheduler: subprocess.Popen[bytes], workers: int) -> str:
    """Of a scheduler that has all its workers."""
    from distributed import Client

    end = time.monotonic() + PATIENCE_S
    while not (file.is_file() and file.read_text("utf-8").rstrip().endswith("}")):
        if scheduler.poll() is not None or time.monotonic() > end:
            raise AssertionError("the Dask scheduler did not come up")
        time.sleep(0.05)
    address = str(json.loads(file.read_text("utf-8"))["address"])
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=PATIENCE_S)
    return address
