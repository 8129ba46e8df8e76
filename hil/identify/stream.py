"""Predicting one sample at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.payload import Payload
from hil.typing import FloatArray

Parts = Callable[[FloatArray, FloatArray, FloatArray], dict[str, FloatArray]]
LoadEffort = Callable[[Payload, FloatArray, FloatArray, FloatArray], FloatArray]


class MemorylessStream:
    """Feeds single samples to a model whose prediction depends on the present sample only.

    Args:
        parts: (1, n) motion → named parts of the effort.
        load_effort: Payload and (1, n) motion → effort of the payload.
        payload: The load mounted.
    """

    def __init__(self, parts: Parts, load_effort: LoadEffort, payload: Payload) -> None:
        self._parts = parts
        self._load_effort = load_effort
        self._payload = payload

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,)."""
        motion = np.atleast_2d(q), np.atleast_2d(qd), np.atleast_2d(qdd)
        effort: FloatArray = np.sum(list(self._parts(*motion).values()), axis=0)
        if not self._payload.is_empty:
            effort = effort + self._load_effort(self._payload, *motion)
        sample: FloatArray = effort[0]
        return sample
