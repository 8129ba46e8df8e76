"""Every call timed by itself; the clock's own time is in it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hil.core.typing import FloatArray
from hil.dynamics import RobotModel
from hil.export.agreement import motion

RATE_HZ = 1000.0
FEWEST = 200
WARM_UP = 30


def timed(step: Callable[..., object], robot: RobotModel, calls: int) -> FloatArray:
    """Nanoseconds of every call of step(q, qd, qdd), a sample of a motion each."""
    samples = list(zip(*motion(robot, max(FEWEST, calls), RATE_HZ), strict=True))
    for sample in samples[:WARM_UP]:
        step(*sample)
    found = np.empty(len(samples))
    for k, sample in enumerate(samples):
        begin = time.perf_counter_ns()
        step(*sample)
        found[k] = time.perf_counter_ns() - begin
    return found


def told(name: str, ns: FloatArray) -> dict[str, float]:
    """Median, 99th percentile and largest, under the contestant's name."""
    p50, p99 = np.percentile(ns, [50, 99])
    return {
        f"{name}_p50_ns": float(p50),
        f"{name}_p99_ns": float(p99),
        f"{name}_max_ns": float(np.max(ns)),
    }
