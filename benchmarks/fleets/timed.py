"""What ways of fitting take: wall time, and processor time of every process that has a part."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from subprocess import Popen

from hil.estimators.base import estimator
from hil.models.fleet_fits import FitResult

Fits = Sequence[FitResult]


@dataclass(frozen=True, slots=True, eq=False)
class Took:
    """One way, once.

    Attributes:
        seconds: Wall time.
        cpu_s: Processor time of this process, of its children, and of the cluster.
        fits: What came of it; empty for a way that fits nothing.
        killed: Workers that were.
    """

    seconds: float
    cpu_s: float
    fits: Fits = ()
    killed: int = 0


class Clock:
    """Begins when it is made."""

    def __init__(self, cluster: Sequence[Popen[bytes]] = ()) -> None:
        self._begin, self._cpu = time.perf_counter(), cpu_s(cluster)

    def took(self, fits: Fits = (), cluster: Sequence[Popen[bytes]] = (), killed: int = 0) -> Took:
        """Since then; processes of the cluster are those that are there now."""
        seconds = time.perf_counter() - self._begin
        return Took(seconds, cpu_s(cluster) - self._cpu, fits, killed)


def timed(work: Callable[[], Fits], cluster: Sequence[Popen[bytes]] = ()) -> Took:
    """Measure the time of a task on a cluster that is already running."""
    clock = Clock(cluster)
    return clock.took(work(), cluster)


def cpu_s(cluster: Sequence[Popen[bytes]] = ()) -> float:
    """Processor time so far: this process, children that have ended, and a cluster's that run."""
    now = os.times()
    return sum(now[:4]) + sum(map(_running_s, cluster))


def _running_s(process: Popen[bytes]) -> float:
    if process.poll() is not None:  # it is among the children that have ended
        return 0.0
    import psutil  # type: ignore[import-untyped]  # comes with distributed

    used = psutil.Process(process.pid).cpu_times()
    return float(used.user + used.system)


def nothing() -> FitResult:
    """Import what a fit needs, and do nothing else."""
    estimator("rigid-wls")
    return FitResult()
