"""An arm whose friction remembers, fed one sample at a time."""

from __future__ import annotations

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.estimators.diffnea.arm import DiffneaArm
from hil.estimators.friction.memory import advanced, carried_step
from hil.estimators.stream import one_sample


class DiffneaStream:
    """Carries the friction states from sample to sample; the path begins with the first one.

    Args:
        arm: What turns motion into columns.
        values: Of all parameters.
        gear: (b,) base parameters of the torque through the gears.
        scale: (n,) torque per unit of effort.
        payload: The load mounted.
    """

    def __init__(
        self,
        arm: DiffneaArm,
        values: FloatArray,
        gear: FloatArray,
        scale: FloatArray,
        payload: Payload | None = None,
    ) -> None:
        self._arm, self._values, self._gear, self._scale = arm, values, gear, scale
        self._payload = payload or Payload()
        self._length = arm.friction_values(values)[1][:, 0]
        self._states = {k: np.zeros((1, len(scale))) for k in arm.form.multiples}
        self._last: FloatArray | None = None

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,); qd of exactly 0 holds.

        Raises:
            DataError: An input is not one number per joint.
        """
        motion = one_sample(len(self._scale), q, qd, qdd)
        way = carried_step(motion[0], self._last, motion[1])
        self._last = motion[0]
        self._states = {
            k: advanced(state, way, k * self._length) for k, state in self._states.items()
        }
        load = np.zeros_like(way)
        if not self._payload.is_empty:
            load = self._arm.robot.payload_effort(self._payload, *motion)
        transmitted = self._arm.rigid(self._gear, *motion) + load
        here = self._arm.moment(motion[1], transmitted, self._states)
        torque = self._arm.rigid(self._values, *motion) + self._arm.friction(here, self._values)
        sample: FloatArray = ((torque + load) / self._scale)[0]
        return sample
