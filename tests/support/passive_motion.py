"""Rows of an arm that goes to angles and stays there."""

from __future__ import annotations

import numpy as np

from hil.core.typing import StructArray
from hil.robot.state import state_dtype

RATE_HZ = 125.0
GO, STAY = 1.0, 0.4
PROGRAM = [(0.0, STAY), (0.5, GO), (0.5, STAY), (-0.3, GO), (-0.3, STAY), (0.5, GO), (0.5, STAY)]


def motion(program: list[tuple[float, float]] = PROGRAM, noise: float = 0.0) -> StructArray:
    """The recorded rows of a program: (where at the end [rad], for how long [s])."""
    t, q, qd, at = [0.0], [program[0][0]], [0.0], program[0][0]
    for end, seconds in program:
        n = round(seconds * RATE_HZ)
        s = np.arange(1, n + 1) / n
        t += (t[-1] + s * seconds).tolist()
        q += (at + (end - at) * (10 * s**3 - 15 * s**4 + 6 * s**5)).tolist()
        qd += ((end - at) * (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds).tolist()
        at = end
    rows = np.zeros(len(t), state_dtype(6))
    rows["device_time"] = t
    rows["q"] = np.array(q)[:, None]
    rows["qd"] = np.array(qd)[:, None]
    rows["qd"] += np.random.default_rng(0).uniform(-noise, noise, rows["qd"].shape)
    return rows
