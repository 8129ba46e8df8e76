"""What is measured of either master, in the same way: times, overruns, CPU time of its process."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks.can_bus.ending import forbid_priority
from hil.core.typing import IntArray
from hil_drivers.cia402.timing import Histogram, Schedule

SETTLE_S = 0.4
"""From the first cycles to what is measured [s]."""

AMPLITUDE = 30_000
"""Of the motion that is played [increments]."""


class Times(Schedule):
    """When cycles begin, for either master; one whose answers have not all come is an overrun too.

    Attributes:
        answering: From sending SYNC to having decoded the last answer.
        complete: Written by the master: whether all answers of this cycle have come.
    """

    def __init__(self, period_s: float) -> None:
        super().__init__(period_s)
        self.answering, self.complete = Histogram(), True

    def done(self) -> None:
        """See `Schedule`."""
        before = self.overrun
        super().done()
        if not self.complete and self.overrun == before:
            self.overrun += 1


class Stretch:
    """From its making to `figures`: what a master has done in between.

    Args:
        times: Of its cycles; their histograms begin anew.
    """

    def __init__(self, times: Times) -> None:
        self._times = times
        times.lateness, times.lasting, times.answering = Histogram(), Histogram(), Histogram()
        self._cycles, self._overrun = times.cycles, times.overrun
        self._cpu_s, self._wall_s = time.process_time(), time.monotonic()

    def figures(self) -> dict[str, float]:
        """Return times in µs and shares in percent; call it at the end of the measurement."""
        cpu_s, wall_s = time.process_time() - self._cpu_s, time.monotonic() - self._wall_s
        times = self._times
        cycles = max(times.cycles - self._cycles, 1)
        return {
            "cycles": float(cycles),
            "cycles_in_all": float(times.cycles),
            "rate_hz": cycles / wall_s,
            "cycle_p50_us": 1e6 * times.answering.percentile(50),
            "cycle_p99_us": 1e6 * times.answering.percentile(99),
            "jitter_p50_us": 1e6 * times.lateness.percentile(50),
            "jitter_p99_us": 1e6 * times.lateness.percentile(99),
            "jitter_p999_us": 1e6 * times.lateness.percentile(99.9),
            "overrun_percent": 100.0 * (times.overrun - self._overrun) / cycles,
            "cpu_us": 1e6 * cpu_s / cycles,
        }


def tell(measure: Callable[[str, float, float], dict[str, float]]) -> None:
    """Measure what the command line says, and print it: CHANNEL RATE_HZ SECONDS, ordinary."""
    channel, rate_hz, seconds, *more = sys.argv[1:]
    if "ordinary" in more:
        forbid_priority()
    print(json.dumps(measure(channel, float(rate_hz), float(seconds))), flush=True)


def swing(rate_hz: float, seconds: float, n: int) -> IntArray:
    """(N, n) positions of a motion of all axes at 0.5 Hz, from and to 0 [increments]."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    one = np.rint(AMPLITUDE * (1.0 - np.cos(np.pi * t))).astype(np.int64)
    return np.repeat(one[:, None], n, axis=1)
