"""Arm under the mock UR controller, which follows a set-point and returns a `Reading` per tick.

`Body` extends `ServoArm` for a UR controller: it starts with closed brakes, can ignore a declared
payload, and computes torques with the controller's model of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.servo_arm import ServoArm
from hil_mock_robot.plant.simulation import Setting
from hil_mock_robot.plant.truth import Truth


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Values that the joints report at the end of a tick; all arrays have shape (6,).

    Attributes:
        q, qd: Measured position [rad] and velocity [rad/s].
        current: Measured motor current [A].
        temperature: Joint temperature [°C].
        current_target: Motor current from the servo's model [A].
        moment_target: Set-point torque from the controller's model, without friction [N·m].
        true_q, true_qd: Position and velocity without noise, for tests and the journal.
        fault: Fault code of `plant.records.FAULTS`; 0 for none.
    """

    q: FloatArray
    qd: FloatArray
    current: FloatArray
    temperature: FloatArray
    current_target: FloatArray
    moment_target: FloatArray
    true_q: FloatArray
    true_qd: FloatArray
    fault: int


class Body(ServoArm):
    """Arm of a UR controller, under power or held by its brakes.

    Args:
        truth: True parameters of the arm.
        rate_hz: Ticks per second.
        q: Joint position when the arm is switched on, (6,) [rad].
        mounted: Payload that is really mounted on the flange; None for the declared payload.

    Attributes:
        arm: Published description of the arm, with the joint limits of the safety settings.
        deaf: Whether the controller ignores payload declarations and retains its payload.
    """

    def __init__(
        self, truth: Truth, rate_hz: float, q: FloatArray, *, mounted: Payload | None = None
    ) -> None:
        super().__init__(truth, Setting(rate_hz), q, mounted=mounted)
        self.arm: ArmDescription = self.published
        self.braked = True
        self.deaf = False

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Gravity vector in the base frame [m/s²]."""
        return self.simulation.setting.gravity

    @property
    def pushed(self) -> FloatArray:
        """External joint torque that acts at present, (6,) [N·m]."""
        return self.simulation.disturbances.push

    def step(self, setpoint: FloatArray) -> Reading:
        """Follow a set-point (3, 6) for one tick.

        An arm with closed brakes ignores the set-point.
        """
        samples = self.follow(setpoint[None])
        if not len(samples):  # the simulation has diverged: close the brakes
            self.braked = True
            nan = np.full(self.arm.n_joints, np.nan)
            return Reading(nan, nan, nan, nan, nan, nan, nan, nan, samples.fault)
        q, qd, current, celsius = (each[0] for each in self.measure(samples))
        target = samples["current_target"][0]
        moment = np.zeros_like(target) if self.braked else self.simulation.moment_target
        return Reading(
            q, qd, current, celsius, target, moment, samples["q"][0], samples["qd"][0],
            samples.fault,
        )  # fmt: skip

    def declare(self, payload: Payload) -> None:
        """Declare a payload; the declaration is ignored if `deaf` is set."""
        if not self.deaf:
            super().declare(payload)

    def forget(self) -> None:
        """Reset the declared payload to no payload; the mounted payload does not change."""
        hanging, self.declared = self.mounted, Payload()
        self.simulation.set_payloads(hanging, self.declared)

    def heat(self, joint: int, celsius: float) -> None:
        """Set the temperature of one joint [°C]."""
        self.simulation.joints.states["celsius"][joint] = celsius

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the mass matrix (6, 6) of the controller's model at `q` (6,) [kg·m²]."""
        return self.simulation.nominal.mass_matrix(q)

    def torque_for(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the torque (6,) of a motion in the controller's model, without friction [N·m]."""
        return self.simulation.nominal.inverse(q, qd, qdd)
