"""Predicting an arm that moves and stops, one sample at a time."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from hil.data.arrival import POINTS, STEP_S, Track, arrival
from hil.data.dataset import Conditions, Dataset
from hil.data.dwells import SAMPLES_PER_DWELL
from hil.payload import Payload
from hil.typing import FloatArray

if TYPE_CHECKING:
    from hil.identify.static_friction import StaticFriction

KEPT_S = 10.0
"""A joint that came to rest longer ago than this has no known approach any more [s]."""


class RestStream:
    """Feeds single samples to a model of friction at rest.

    Friction is known once the arm has stood for ten samples; before that, and in motion, the
    prediction is gravity, offset and load.

    Args:
        model: Fitted.
        payload: The load mounted.
        period_s: Time between samples [s].
    """

    def __init__(self, model: StaticFriction, payload: Payload, period_s: float) -> None:
        self._model = model
        self._payload = payload
        self._period = period_s
        kept = round(KEPT_S / period_s)
        self._q: deque[FloatArray] = deque(maxlen=kept)
        self._qd: deque[FloatArray] = deque(maxlen=kept)
        self._rested = 0
        self._path: FloatArray | None = None

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,)."""
        self._q.append(np.array(q, dtype=np.float64))
        self._qd.append(np.array(qd, dtype=np.float64))
        still = float(np.max(np.abs(qd))) < self._model.rest_speed
        self._rested = self._rested + 1 if still else 0
        effort: FloatArray = self._model.predict(self._present()).effort[0]
        return effort

    def _present(self) -> Dataset:
        """This sample as a dwell, or as one of whose approach nothing is known."""
        q = self._q[-1][None, :]
        zero = np.zeros_like(q)
        return Dataset(
            robot=self._model.robot_.name,
            joint_names=self._model.joint_names_,
            effort_kind="torque" if self._model.effort_kind_ == "torque" else "current",
            columns={"t": np.zeros(1), "q": q, "effort": zero},
            offsets=np.array([0, 1]),
            conditions=(Conditions("now", "dwell", payload=self._payload),),
            gravity=tuple(self._model.robot_.gravity_vector.tolist()),
            arrivals=self._arrival(),
        )

    def _arrival(self) -> FloatArray | None:
        """(1, K, 2, n); looked for while the path into the pose may still be going on."""
        if self._rested < SAMPLES_PER_DWELL:
            self._path = None
            return None
        if self._path is None or self._rested * self._period < POINTS * STEP_S + 0.1:
            t = self._period * np.arange(len(self._q), dtype=np.float64)
            track = Track(t, np.array(self._q), np.array(self._qd))
            first = t[-SAMPLES_PER_DWELL]
            self._path = arrival(track, float(first), float(t[-1]))[None]
        return self._path
