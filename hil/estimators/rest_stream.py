"""Predicting an arm that moves and stops, one sample at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from hil.core import FloatArray
from hil.data import POINTS, SAMPLES_PER_DWELL, STEP_S, Track, arrival
from hil.estimators.stream import one_sample

KEPT_S = 2.0
"""A joint that came to rest longer ago than this has no known approach any more [s]."""

FORMING_S = POINTS * STEP_S + 0.1
"""Standing still for so long, the arm has the whole path into the pose behind it [s]."""

AGAIN_S = 0.04
"""While the path goes on, friction is computed again this often [s]: it takes milliseconds."""


class RestStream:
    """Feeds single samples to a model of friction at rest.

    Friction is known once the arm has stood for ten samples; before that, and in motion, the
    prediction is all but friction.

    Args:
        n: Number of joints.
        standing: (1, n) positions → (1, n) effort without friction.
        friction: (1, K, 2, n) path (`hil.data.approach_path`) and (1, n) positions → (1, n)
        friction.
        rest_speed: Slower than this, every joint is at rest [rad/s].
        period_s: Time between samples [s].
    """

    def __init__(
        self,
        n: int,
        standing: Callable[[FloatArray], FloatArray],
        friction: Callable[[FloatArray, FloatArray], FloatArray],
        rest_speed: float,
        period_s: float,
    ) -> None:
        self._n, self._standing, self._friction = n, standing, friction
        self._rest_speed, self._period = rest_speed, period_s
        kept = round(KEPT_S / period_s)
        self._q: deque[FloatArray] = deque(maxlen=kept)
        self._qd: deque[FloatArray] = deque(maxlen=kept)
        self._again = max(1, round(AGAIN_S / period_s))
        self._rested = 0
        self._held: FloatArray | None = None

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,).

        Raises:
            DataError: An input is not one number per joint.
        """
        position, speed, _ = one_sample(self._n, q, qd, qdd)
        self._q.append(position[0].copy())
        self._qd.append(speed[0].copy())
        still = float(np.max(np.abs(speed))) < self._rest_speed
        self._rested = self._rested + 1 if still else 0
        effort = self._standing(position)
        held = self._friction_held(position)
        now: FloatArray = (effort if held is None else effort + held)[0]
        return now

    def _friction_held(self, position: FloatArray) -> FloatArray | None:
        """(1, n) friction of an arm at rest; None in motion."""
        stood = self._rested - SAMPLES_PER_DWELL
        if stood < 0:
            self._held = None
        elif self._held is None or (
            stood % self._again == 0 and self._rested * self._period < FORMING_S
        ):
            self._held = self._friction(self._path()[None], position)
        return self._held

    def _path(self) -> FloatArray:
        t = self._period * np.arange(len(self._q), dtype=np.float64)
        track = Track(t, np.array(self._q), np.array(self._qd))
        return arrival(track, float(t[-SAMPLES_PER_DWELL]), float(t[-1]))
