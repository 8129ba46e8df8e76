"""The arm under the mock UR controller: a set-point in, one `Reading` per tick out.

`Body` is a `ServoArm` with what a UR controller does to it: it starts on its brakes, may be deaf to
a declared load, and its model of the arm is asked for torques.
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
    """Reports of the joints at the end of a tick; arrays are (6,).

    Attributes:
        q, qd: Measured position [rad] and velocity [rad/s].
        current: Measured motor current [A].
        temperature: [°C].
        current_target: Current by the servo's model [A].
        moment_target: Torque of the set-point by the controller's model, without friction [N·m].
        true_q, true_qd: Without noise, for tests and the journal.
        fault: 0, or a code of `plant.records.FAULTS`.
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
    """The arm of a UR controller, powered or standing on its brakes.

    Args:
        truth: Its true parameters.
        rate_hz: Ticks per second.
        q: (6,) where it stands when it is switched on [rad].
        mounted: The load that really hangs at the flange; the declared one when None.

    Attributes:
        arm: Its published description, with the joint limits of the safety settings.
        deaf: Whether the controller keeps its load, whatever is declared.
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
        """In the base frame [m/s²]."""
        return self.simulation.setting.gravity

    @property
    def pushed(self) -> FloatArray:
        """(6,) the external joint torque that acts [N·m]."""
        return self.simulation.disturbances.push

    def step(self, setpoint: FloatArray) -> Reading:
        """Follow a set-point (3, 6) for one tick; closed brakes ignore it."""
        samples = self.follow(setpoint[None])
        if not len(samples):  # the simulation has run away: it ends here, on the brakes
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
        """See `ServoArm`; a deaf controller keeps the load that it has."""
        if not self.deaf:
            super().declare(payload)

    def forget(self) -> None:
        """Compute with no load any more; the load at the flange stays there."""
        hanging, self.declared = self.mounted, Payload()
        self.simulation.set_payloads(hanging, self.declared)

    def heat(self, joint: int, celsius: float) -> None:
        """Set the temperature of one joint [°C]."""
        self.simulation.joints.states["celsius"][joint] = celsius

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return (6, 6) of the controller's model at `q` (6,) [kg·m²]."""
        return self.simulation.nominal.mass_matrix(q)

    def torque_for(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return (6,) torque of a motion by the controller's model, without friction [N·m]."""
        return self.simulation.nominal.inverse(q, qd, qdd)
