"""Arm of the mock PLC: a `ServoArm` whose drives report torques or currents."""

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
        q, qd: Measured position [rad] and velocity [rad/s].
        effort, effort_target: Torque at the joint [N·m] or motor current [A], measured and target.
        celsius: Joint temperature [°C].
        true_qd: Velocity without noise, for the journal [rad/s].
        fault: Fault code of `plant.records.FAULTS` in the last cycle; 0 for none.
    """

    q: FloatArray
    qd: FloatArray
    effort: FloatArray
    celsius: FloatArray
    effort_target: FloatArray
    true_qd: FloatArray
    fault: int


class PlcArm(ServoArm):
    """Arm of the mock PLC.

    Args:
        truth: True parameters of the arm.
        rate_hz: Cycles per second.
        q: Joint position at the start, (n,) [rad].
        torque: Whether the drives report torques, converted by the published drive gains, instead
            of currents.
        mounted: Payload that is mounted on the flange; None for the declared payload.
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
        """Follow set-points (N, 3, n), one per cycle, and return the measurements.

        Fewer than N measurements are returned if the simulation ends with a fault.
        """
        samples = self.follow(setpoints)
        q, qd, current, celsius = self.measure(samples)
        return Measured(
            q, qd, current * self._gains, celsius, samples["current_target"] * self._gains,
            samples["qd"], samples.fault,
        )  # fmt: skip
