"""Python, cores and what uses them, the disk, and whether cycles may be kept."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hil.doctor.finding import Finding

LEAST_PYTHON = (3, 11)
LOW_DISK_BYTES = 2e9


def python() -> Iterator[Finding]:
    """Versions, and how many cores this process may use."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("python", version, "ok" if sys.version_info >= LEAST_PYTHON else "bad")
    yield Finding("hil", importlib.metadata.version("hil"))
    yield Finding("cores", str(cores()))


def cores() -> int:
    """What this process may use, which in a container is less than the computer has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def blas() -> Iterator[Finding]:
    """Threads that linear algebra starts in every process: idle ones spin beside the others."""
    import threadpoolctl

    np.dot(np.eye(2), np.eye(2))  # the library is loaded when it is used
    pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    threads = max((int(pool["num_threads"]) for pool in pools), default=1)
    told = f"{threads} per process, {cores()} cores"
    if threads > cores():
        told += "; more threads than cores wait for each other: export OMP_NUM_THREADS=1"
    yield Finding("blas threads", told, "note" if threads > cores() else "ok")


def disk() -> Iterator[Finding]:
    """Room where runs are kept by default."""
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 1e9:.1f} GB free here"
    yield Finding("disk", text, "ok" if free > LOW_DISK_BYTES else "bad")


def real_time() -> Iterator[Finding]:
    """Whether a driver that owns the clock of a bus may ask to be woken in time."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
    except (AttributeError, OSError):
        text = "not permitted: cycles of a CAN driver may come late while the computer is busy; "
        yield Finding("real-time", f"{text}LimitRTPRIO=80, or ulimit -r 80, permits it", "note")
        return
    yield Finding("real-time", "SCHED_FIFO is permitted")
