"""Wall time less what a busy computer took: by this a bound on a program's own haste is judged.

A program that has a tenth of a second to do a thing cannot do it while others have its core. What
it is made for leaves it one; a machine that tests in parallel does not. The kernel counts how long
each thread was ready to run and waited for a core, so sleeps, locks, disks and timers of the code
itself count in full. Of processes that are waited for it is the most that they may have delayed
us: they may have waited for a core beside us, not in our way. On a computer that is idle nothing
is taken off.
"""

from __future__ import annotations

import time
from pathlib import Path

_NS = 1e-9


class OwnTime:
    """Begins when it is made; to be read in the thread that made it.

    Args:
        *pids: Processes besides this one that something is waited for; whichever of its threads
            waited longest counts.

    Attributes:
        at: When it was made, as `time.monotonic` tells it [s].
    """

    def __init__(self, *pids: int) -> None:
        self._tasks = [Path(f"/proc/{pid}/task") for pid in pids]
        self._ours = _waited_s(Path("/proc/thread-self"))
        self._theirs = [_by_thread(tasks) for tasks in self._tasks]
        self.at = time.monotonic()

    @property
    def hindered_s(self) -> float:
        """How long those who had something to do were kept from doing it [s]."""
        return _waited_s(Path("/proc/thread-self")) - self._ours + self.theirs_s

    @property
    def theirs_s(self) -> float:
        """The same of the other processes alone [s]."""
        both = zip(self._tasks, self._theirs, strict=True)
        return sum(_longest(before, _by_thread(tasks)) for tasks, before in both)

    @property
    def passed_s(self) -> float:
        """Since it was made, but for that [s]."""
        return time.monotonic() - self.at - self.hindered_s


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
