"""State rows of the arm: what its controller commands and what its sensors report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray, StructArray
from hil.robot import Status, state_dtype
from hil_mock_robot.arm import Arm
from hil_mock_robot.sensors import Sensors

if TYPE_CHECKING:
    from hil_mock_robot.simulation import Samples

EPOCH_S = 1_767_225_600.0
"""Host time at which every mock robot is switched on: 2026-01-01 00:00 UTC."""
MODE_POSITION, MODE_TORQUE = 0, 1
FAULTY = int(Status.FAULT | Status.MASKED)


class Sampling:
    """Advances an arm and measures it.

    Args:
        arm: Switched on before the first sample.

    Attributes:
        qd: (N, n) true joint speeds of the newest samples [rad/s].
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._sensors = Sensors(arm.truth, arm.day)
        self._dtype = state_dtype(arm.description.n_joints)
        self.qd: FloatArray = np.zeros((0, arm.description.n_joints))

    def advance(self, count: int) -> StructArray:
        """Rows of up to `count` samples, not past the end of the running segment.

        A fault that the samples lead to ends them, and their last row says so. A broken-down
        simulation gives none.
        """
        arm, before = self._arm, self._arm.fault
        if arm.dead:
            return np.zeros(0, dtype=self._dtype)
        rows, samples = (self._by_torque if arm.torque_controlled else self._by_position)(count)
        self.qd = samples["qd"]
        if samples.fault:
            arm.lock(samples.fault)
        if arm.fault:
            faulty = rows if before else rows[-1:]
            faulty["status"] |= FAULTY
            faulty["fault_code"] = arm.fault
        return rows

    def _by_position(self, count: int) -> tuple[StructArray, Samples]:
        arm, simulation = self._arm, self._arm.on
        setpoints, status = arm.motion.take(count)
        first = simulation.samples
        samples = simulation.stand(len(status)) if arm.locked else simulation.advance(setpoints)
        rows = self._measured(samples, first)
        done = len(rows)
        rows["status"] = status[:done]
        for k, field in enumerate(("q_target", "qd_target", "qdd_target")):
            rows[field] = setpoints[:done, k]
        rows["effort_target"] = samples["current_target"]
        return rows, samples

    def _by_torque(self, count: int) -> tuple[StructArray, Samples]:
        arm, simulation = self._arm, self._arm.on
        simulation.track(simulation.position, np.zeros(arm.description.n_joints))
        held = np.repeat(simulation.setpoint[None], count, axis=0)
        first = simulation.samples
        samples = simulation.advance(held)
        rows = self._measured(samples, first)
        rows["status"], rows["mode"] = int(Status.MOVING), MODE_TORQUE
        for field in ("q_target", "qd_target", "qdd_target"):
            rows[field] = np.nan
        rows["effort_target"] = simulation.disturbances.torque / arm.description.drive_gains
        return rows, samples

    def _measured(self, samples: Samples, first: int) -> StructArray:
        """Rows with everything that is measured."""
        arm = self._arm
        rows = np.zeros(len(samples), dtype=self._dtype)
        rows["device_time"] = (first + 1 + np.arange(len(rows))) / arm.rate_hz
        rows["host_time"] = EPOCH_S + rows["device_time"]
        rows["segment"] = arm.motion.segment
        measured = self._sensors.measure(
            samples["q"], samples["qd"], samples["current"], samples["celsius"]
        )
        rows["q"], rows["qd"], rows["effort"], rows["temperature"] = measured
        return rows
