"""The problem everybody solves, and the stopwatch that is read after every epoch."""

from __future__ import annotations

import contextlib
import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core.typing import FloatArray, IntArray
from hil.networks.lm import Scaling, checked_rows
from hil.networks.mlp import Mlp

LAYERS = (4, 20, 20, 10, 1)
SAMPLES = 10
NOISE_A = 0.005


@dataclass(frozen=True)
class Terms:
    """What a contestant is told on its command line.

    Attributes:
        poses: Of ten samples each.
        seed: Of the rows and the start.
        iterations: At most.
        limit_s: CPU time at most.
        target: RMSE on all rows to stop at; 0 runs on.
    """

    poses: int
    seed: int
    iterations: int
    limit_s: float
    target: float

    @staticmethod
    def told() -> Terms:
        """From the command line, in the order of the attributes."""
        poses, seed, iterations, limit_s, target = sys.argv[1:]
        return Terms(int(poses), int(seed), int(iterations), float(limit_s), float(target))


@dataclass(frozen=True)
class Problem:
    """The rows and the start.

    Attributes:
        X: (N, 4) joint angles [rad].
        y: (N,) friction current [A].
        pose: (N,).
        start: (P,) weights for inputs and target brought to mean 0 and variance 1.
        scaling: That does so.
    """

    X: FloatArray
    y: FloatArray
    pose: IntArray
    start: FloatArray
    scaling: Scaling


def problem(terms: Terms) -> Problem:
    """Return a smooth function of four joint angles, its noise, and start weights, by seed."""
    random = np.random.default_rng(terms.seed)
    q = random.uniform(-np.pi, np.pi, (terms.poses, LAYERS[0]))
    smooth = 0.08 * np.tanh(1.2 * np.sin(q[:, 0]) + 0.5 * np.cos(q[:, 1] + q[:, 2]))
    smooth += 0.05 * np.sin(q[:, 3]) * np.cos(q[:, 2]) + 0.03 * np.sin(2 * q[:, 1])
    pose = np.repeat(np.arange(terms.poses), SAMPLES)
    y = smooth[pose] + NOISE_A * random.standard_normal(len(pose))
    start = Mlp(LAYERS).initial(terms.seed)
    return Problem(q[pose], y, pose, start, Scaling.of(checked_rows(q[pose], y)))


class TimeUp(Exception):
    """The target is reached, or the time is over."""


class Stopwatch:
    """Notes CPU time and RMSE after every epoch; what asking for the RMSE costs is not counted.

    Attributes:
        cpu_s: CPU time from the start of the training to the end of each epoch, the start first.
        rmse: On all rows then [A].
        peak_mib: Memory beyond what was in use before the training.
    """

    def __init__(self, terms: Terms) -> None:
        self._terms, self._judging, self._memory = terms, 0.0, peak_mib()
        self.cpu_s: list[float] = []
        self.rmse: list[float] = []
        self.peak_mib = 0.0
        self._begin = time.process_time()

    def elapsed(self) -> float:
        """CPU seconds since the start."""
        return time.process_time() - self._begin - self._judging

    def note(self, rmse: Callable[[], float]) -> None:
        """After an epoch, and once before the first.

        Raises:
            TimeUp: Enough.
        """
        elapsed, asked = self.elapsed(), time.process_time()
        self.cpu_s.append(elapsed)
        self.rmse.append(rmse())
        self.peak_mib = peak_mib() - self._memory
        self._judging += time.process_time() - asked
        self.stop_when_over()
        if self.rmse[-1] <= self._terms.target:
            raise TimeUp

    def stop_when_over(self) -> None:
        """For contestants that may stay within an epoch for ever.

        Raises:
            TimeUp: The time is over.
        """
        if self.elapsed() > self._terms.limit_s:
            raise TimeUp


def contest(solve: Callable[[Terms, Problem, Stopwatch], None]) -> None:
    """Solve the problem of the command line on one BLAS thread, and print the course as JSON."""
    terms = Terms.told()
    with threadpool_limits(1):
        rows = problem(terms)
        watch = Stopwatch(terms)
        with contextlib.suppress(TimeUp):
            solve(terms, rows, watch)
    print(json.dumps({key: getattr(watch, key) for key in ("cpu_s", "rmse", "peak_mib")}))


def skip(reason: str) -> None:
    """Print why this contestant does not take part."""
    print(json.dumps({"skipped": reason}))


def peak_mib() -> float:
    """Most memory this process ever had resident.

    Linux hands `ru_maxrss` on to what a process starts, so that a contestant would begin with the
    peak of whoever runs the benchmark; `VmHWM` begins anew.
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text("utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1024 * 1024 if sys.platform == "darwin" else 1024)
