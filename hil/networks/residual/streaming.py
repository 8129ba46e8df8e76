"""A corrected model one sample at a time."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.data import Stream
from hil.networks.residual.correction import Correction
from hil.networks.residual.ring import RingTcn


class CorrectedStream:
    """Steps the physics, then networks with ring buffers on what it says.

    Args:
        base: Stream of the physics.
        correction: Networks that hear no torque.
    """

    def __init__(self, base: Stream, correction: Correction) -> None:
        self._base, self._correction = base, correction
        wanted = correction.networks if np.any(correction.kept) else ()
        self._rings = [RingTcn(network) for network in wanted]

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,).

        Raises:
            DataError: An input is not one number per joint.
        """
        effort = self._base.step(q, qd, qdd)
        if not self._rings:
            return effort
        mean = np.mean([ring.step(q, qd, qdd, effort) for ring in self._rings], axis=0)
        return np.asarray(effort + self._correction.bounded(mean))
