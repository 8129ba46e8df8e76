"""What a thread that must be on time asks of the kernel and of Python, and what it gets."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator

PRIORITY = 50
"""Of SCHED_FIFO: above ordinary work, below the kernel's own threads."""

SWITCH_S = 2e-4
"""How long another Python thread may keep the interpreter from ours; 5 ms unless told [s]."""

SOON_NICE = -10

SLACK_NS = 1_000
"""By how much the kernel may wake us late to save wake-ups; 50 µs unless told."""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2


@contextlib.contextmanager
def realtime(*, lock_memory: bool = False) -> Iterator[list[str]]:
    """What helps while the block runs, for the calling thread and this process.

    Garbage is collected at no time of its own choosing: whoever runs the thread calls
    `gc.collect` while the arm rests.

    Args:
        lock_memory: Keep all of this process in memory.

    Yields:
        What was not permitted, in words; empty when all was.
    """
    refused = [_scheduled_first(), _locked() if lock_memory else ""]
    _exact_timers()
    before = _others_sooner()
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH_S)
    gc.freeze()
    gc.disable()
    try:
        yield [text for text in refused if text]
    finally:
        sys.setswitchinterval(switch_s)
        gc.unfreeze()
        if collects:
            gc.enable()
        _set_nice(before)


def _scheduled_first() -> str:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        return (
            f"no real-time priority ({getattr(error, 'strerror', error)}): cycles may begin late "
            f"under load; permit it with `ulimit -r {PRIORITY}` (limits.conf: rtprio)"
        )
    return ""


def _others_sooner() -> dict[int, int]:
    """Let the other threads of this process run soon; returns how nice they were.

    One that has the interpreter and not the processor keeps ours waiting, whatever its priority.
    """
    before: dict[int, int] = {}
    for name in os.listdir("/proc/self/task") if os.path.isdir("/proc/self/task") else ():
        with contextlib.suppress(OSError):
            before[int(name)] = os.getpriority(os.PRIO_PROCESS, int(name))
    _set_nice(dict.fromkeys(before, SOON_NICE))
    return before


def _set_nice(values: dict[int, int]) -> None:
    for thread, value in values.items():
        with contextlib.suppress(OSError):  # it has ended, or it is not permitted
            os.setpriority(os.PRIO_PROCESS, thread, value)


def _locked() -> str:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
        return ""
    return f"memory is not locked ({os.strerror(ctypes.get_errno())}): limits.conf: memlock"


def _exact_timers() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(SLACK_NS), 0, 0, 0)
