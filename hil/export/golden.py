"""Golden vectors: a motion, and what the model in Python says of it, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator
from hil.networks import CorrectedModel

RATE_HZ = 250.0
SAMPLES = 300
REACH_RAD = 2.0
"""Of joints without limits."""

LOAD = Payload(mass=1.5, com=(0.02, -0.03, 0.06), inertia=(0.004, 0.005, 0.003, 1e-4, -2e-4, 3e-4))
"""Mounted for the second half: a program that places its load wrongly is found out."""

AGREES = 1e-4
"""Largest difference of a program, as a share of each joint's largest effort."""

JITTER, SLOW = 2e-4, 0.1
"""Of an encoder [rad or m], to and fro where joints are slower than this share of their fastest.

There positions go against velocities, which memory has to be told from a way.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Golden:
    """What a program is checked with.

    Attributes:
        q, qd, qdd: (N, n).
        bare: (N, n) efforts without a load.
        loaded: (N, n) with `LOAD`, from the start again.
        residuals: (2, N, n) what of both a residual network adds; None where there is none.
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    bare: FloatArray
    loaded: FloatArray
    residuals: FloatArray | None = None


def golden_of(model: RobotEstimator, samples: int = SAMPLES, rate_hz: float = RATE_HZ) -> Golden:
    """Vectors of a fitted model, by its own stream."""
    q, qd, qdd = motion(model.robot_, samples, rate_hz)
    q = jittered(q, qd)
    bare, loaded = (_streamed(model, q, qd, qdd, load) for load in (Payload(), LOAD))
    residuals = None
    if isinstance(model, CorrectedModel) and np.any(model.correction_.kept):
        inner = (_streamed(model.base_, q, qd, qdd, load) for load in (Payload(), LOAD))
        residuals = np.stack([bare, loaded]) - np.stack(list(inner))
    return Golden(q, qd, qdd, bare, loaded, residuals)


def jittered(q: FloatArray, qd: FloatArray) -> FloatArray:
    """Q (N, n) as an encoder reads it around reversals and at rest: one step to and fro."""
    way = JITTER * (-1.0) ** np.arange(len(q))[:, None]
    slow = np.abs(qd) < SLOW * np.abs(qd).max(axis=0)
    return np.asarray(q + way * slow)


def motion(robot: RobotModel, samples: int, rate_hz: float) -> tuple[FloatArray, ...]:
    """q, qd, qdd (N, n): waves within the limits with reversals, and every joint at rest a while.

    Args:
        robot: Says how many joints there are and how far they go.
        samples: N.
        rate_hz: Of the samples.
    """
    t = np.arange(samples) / rate_hz
    low = np.where(np.isfinite(robot.q_min), robot.q_min, -REACH_RAD)
    high = np.where(np.isfinite(robot.q_max), robot.q_max, REACH_RAD)
    middle, reach = 0.5 * (low + high), 0.3 * np.minimum(high - low, 2 * REACH_RAD)
    j = np.arange(robot.n)
    w = 2 * np.pi * (0.4 + 0.15 * j)
    angle = w * t[:, None] + 0.7 * j
    q, qd = middle + reach * np.sin(angle), reach * w * np.cos(angle)
    qdd = -reach * w**2 * np.sin(angle)
    for joint in range(robot.n):
        start = samples // 2 + joint * (samples // 60)
        rest = slice(start, start + samples // 10)
        q[rest, joint], qd[rest, joint], qdd[rest, joint] = q[rest.start, joint], 0.0, 0.0
    return q, qd, qdd


def _streamed(
    model: RobotEstimator, q: FloatArray, qd: FloatArray, qdd: FloatArray, load: Payload
) -> FloatArray:
    stream = model.stream(load)
    return np.array([stream.step(*sample) for sample in zip(q, qd, qdd, strict=True)])
