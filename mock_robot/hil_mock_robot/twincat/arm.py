"""The arm behind the PLC: a `ServoArm` whose drives report torques or currents."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil_mock_robot.plant.servo_arm import ServoArm
from hil_mock_robot.plant.simulation import Setting
from hil_mock_robot.plant.truth import Truth


class Measured(NamedTuple):
    """Measurements of the drives in N cycles; arrays are (N, n).

    Attributes:
        q, qd: [rad], [rad/s].
        effort, effort_target: Torque at the joint [N·m] or motor current [A].
        celsius: [°C].
        true_qd: Without noise, for the journal.
        fault: 0, or a code of `plant.records.FAULTS` that holds for the last cycle.
    """

    q: FloatArray
    qd: FloatArray
    effort: FloatArray
    celsius: FloatArray
    effort_target: FloatArray
    true_qd: FloatArray
    fault: int


class PlcArm(ServoArm):
    """The arm behind the PLC.

    Args:
        truth: Its true parameters.
        rate_hz: Cycles per second.
        q: (n,) where it stands [rad].
        torque: Whether the drives report torques, by the published constants, or currents.
        mounted: The load that really hangs at the flange; the declared one when None.
    """

    def __init__(
        self,
        truth: Truth,
        rate_hz: float,
        q: FloatArray,
        *,
        torque: bool = True,
        mounted: Payload | None = None,
    ) -> None:
        super().__init__(truth, Setting(rate_hz), q, mounted=mounted)
        self._gains = self.published.drive_gains if torque else np.ones(len(q))

    def advance(self, setpoints: FloatArray) -> Measured:
        """Follow set-points (N, 3, n), one a cycle; fewer come back when the last has a fault."""
        samples = self.follow(setpoints)
        q, qd, current, celsius = self.measure(samples)
        return Measured(
            q, qd, current * self._gains, celsius, samples["current_target"] * self._gains,
            samples["qd"], samples.fault,
        )  # fmt: skip
