"""How far, how fast and how hard each joint goes in a set of motions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.excitation import Motion


@dataclass(frozen=True, slots=True, eq=False)
class Extremes:
    """Over all samples: `q_min`, `q_max` [rad], `qd_max` [rad/s], `qdd_max` [rad/s²], each (n,)."""

    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray


def extremes_of(motions: Iterable[Motion], rate_hz: float) -> Extremes:
    """The extremes of at least one motion at its set-points; repeated motions cost once."""
    rows = [_extremes(motion, rate_hz) for motion in dict.fromkeys(motions)]
    least, most, speed, acceleration = (np.array(column) for column in zip(*rows, strict=True))
    return Extremes(
        least.min(axis=0), most.max(axis=0), speed.max(axis=0), acceleration.max(axis=0)
    )


def _extremes(motion: Motion, rate_hz: float) -> tuple[FloatArray, ...]:
    samples = motion.sample(rate_hz)
    return (
        np.minimum(motion.q_start, samples.q.min(axis=0)),
        np.maximum(motion.q_start, samples.q.max(axis=0)),
        np.abs(samples.qd).max(axis=0),
        np.abs(samples.qdd).max(axis=0),
    )
