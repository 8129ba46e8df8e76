"""Bounds on wall time that a busy computer cannot break, and that nothing is taken off of.

A program that has a tenth of a second to do a thing cannot do it while others have its core. What
it is made for leaves it one; a machine that tests in parallel does not. So a bound is one on wall
time, sleeps, locks, disks and all. Where it is broken, and those who had to do the thing waited
for a core at least as long as was too long, the measurement tells nothing: it is made again, and a
test that was never let alone is skipped, visibly. It never passes.

The kernel counts how long each thread was ready to run and waited for a core. Waits overlap each
other, and what was tested may have slept meanwhile: they excuse nothing, they only raise a doubt.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

TIMES = 3
_NS = 1e-9


class TooBusy(pytest.skip.Exception):
    """It took too long, and that may have been the computer."""


@dataclass(frozen=True, slots=True)
class Took:
    """One measurement.

    Attributes:
        passed_s: Wall time [s].
        waited_s: How long at most those who had to do it waited for a core meanwhile [s].
    """

    passed_s: float
    waited_s: float

    def require(self, within_s: float, took_s: float | None = None) -> None:
        """That it took less.

        Args:
            within_s: The bound, on wall time [s].
            took_s: How long it took in truth, as somebody else has seen it; all of it without [s].

        Raises:
            AssertionError: It took too long.
            TooBusy: Likewise, but whoever had to do it was kept from a core for as long.
        """
        took_s = self.passed_s if took_s is None else took_s
        if took_s < within_s:
            return
        told = f"took {took_s:.3f} s, not less than {within_s:g} s"
        if self.waited_s < took_s - within_s:
            raise AssertionError(f"{told}; waited {self.waited_s:.3f} s for a core")
        raise TooBusy(
            f"this computer was too busy to tell: waited {self.waited_s:.3f} s for a core; {told}"
        )


class InTime:
    """Begins when it is made; to be read in the thread that made it.

    Args:
        *pids: Processes besides this thread that have to do it; whichever of a process's threads
            waited longest counts.
        ours: Whether this thread has to do anything but look on.

    Attributes:
        at: When it was made, as `time.monotonic` tells it [s].
    """

    def __init__(self, *pids: int, ours: bool = True) -> None:
        tasks = [Path(f"/proc/{pid}/task") for pid in pids]
        self._before = [(task, _by_thread(task)) for task in tasks]
        self._ours = _waited_s(OURS) if ours else None
        self.at = time.monotonic()

    def taken(self) -> Took:
        """What it took until now."""
        passed_s = time.monotonic() - self.at
        waited_s = 0.0 if self._ours is None else _waited_s(OURS) - self._ours
        waited_s += sum(_longest(before, _by_thread(task)) for task, before in self._before)
        return Took(passed_s, waited_s)

    def require(self, within_s: float, took_s: float | None = None) -> None:
        """That it took less until now; see `Took.require`."""
        self.taken().require(within_s, took_s)


OURS = Path("/proc/thread-self")


def measured_again(test: Callable[..., None]) -> Callable[..., None]:
    """A test that is run again, `TIMES` in all, while it is `TooBusy`; with the same fixtures."""

    @functools.wraps(test)
    def up_to_some_times(*args: Any, **kwargs: Any) -> None:
        for _ in range(TIMES - 1):
            try:
                return test(*args, **kwargs)
            except TooBusy:
                pass
        return test(*args, **kwargs)

    return up_to_some_times


def _longest(before: dict[str, float], now: dict[str, float]) -> float:
    return max((waited - before.get(thread, 0.0) for thread, waited in now.items()), default=0.0)


def _by_thread(tasks: Path) -> dict[str, float]:
    """By thread of a process; of one that has ended none."""
    try:
        return {task.name: _waited_s(task) for task in tasks.iterdir()}
    except OSError:
        return {}


def _waited_s(task: Path) -> float:
    """Ready to run without a core, since it began; 0 where the kernel does not count it."""
    try:
        return int((task / "schedstat").read_text().split()[1]) * _NS
    except (OSError, IndexError, ValueError):
        return 0.0
