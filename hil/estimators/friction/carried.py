"""A model with friction that remembers, fed one sample at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.law import FrictionLaw
from hil.estimators.friction.memory import advanced, carried_step
from hil.estimators.friction.motion import FrictionMotion
from hil.estimators.stream import one_sample

Torque = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Motion (1, n) → rigid body with load, and the torque through the gears, each (1, n) [N·m]."""


class RememberingStream:
    """Carries the friction states from sample to sample; the path begins with the first one.

    Args:
        torque: See `Torque`.
        law: The friction.
        scale: (n,) torque per unit of effort.
    """

    def __init__(self, torque: Torque, law: FrictionLaw, scale: FloatArray) -> None:
        self._torque, self._law, self._scale = torque, law, scale
        still = np.zeros((1, len(scale)))
        self._states = dict.fromkeys(law.multiples, still)
        self._last: FloatArray | None = None

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,); qd of exactly 0 holds.

        Raises:
            DataError: An input is not one number per joint.
        """
        motion = one_sample(len(self._scale), q, qd, qdd)
        step = carried_step(motion[0], self._last, motion[1])
        self._last = motion[0]
        length = self._law.shapes.length
        self._states = {k: advanced(state, step, k * length) for k, state in self._states.items()}
        rigid, transmitted = self._torque(*motion)
        here = FrictionMotion(
            motion[0],
            motion[1],
            transmitted,
            self._law.shapes,
            celsius=None if self._law.celsius is None else self._law.celsius[None],
            given=self._states,
        )
        torque = rigid + sum(self._law.torques(here).values())
        sample: FloatArray = (torque / self._scale)[0]
        return sample
