"""Predicting one sample at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray

Parts = Callable[[FloatArray, FloatArray, FloatArray], dict[str, FloatArray]]
LoadEffort = Callable[[Payload, FloatArray, FloatArray, FloatArray], FloatArray]


def one_sample(n: int, *motion: FloatArray) -> tuple[FloatArray, ...]:
    """Each of (n,) as a row (1, n).

    Raises:
        DataError: One is not a number per joint.
    """
    try:
        rows = tuple(np.asarray(values, dtype=np.float64).reshape(1, -1) for values in motion)
    except (TypeError, ValueError) as error:
        raise DataError(f"a sample of a stream must be numbers: {error}") from error
    if any(row.shape[1] != n for row in rows):
        told = ", ".join(str(np.shape(values)) for values in motion)
        raise DataError(
            f"a sample of this stream is one number for each of {n} joints; its q, qd and qdd "
            f"have the shapes {told}",
            hint="give every joint of the robot that the model was fitted for",
        )
    return rows


class MemorylessStream:
    """Feeds single samples to a model whose prediction depends on the present sample only.

    Args:
        n: Number of joints.
        parts: (1, n) motion → named parts of the effort.
        load_effort: Payload and (1, n) motion → effort of the payload.
        payload: The load mounted.
    """

    def __init__(self, n: int, parts: Parts, load_effort: LoadEffort, payload: Payload) -> None:
        self._n, self._parts = n, parts
        self._load_effort = load_effort
        self._payload = payload

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,).

        Raises:
            DataError: An input is not one number per joint.
        """
        motion = one_sample(self._n, q, qd, qdd)
        effort: FloatArray = np.sum(list(self._parts(*motion).values()), axis=0)
        if not self._payload.is_empty:
            effort = effort + self._load_effort(self._payload, *motion)
        sample: FloatArray = effort[0]
        return sample
