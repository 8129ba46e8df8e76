"""The arm under the controller: set-points in, one reading per tick out, and what goes wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.records import SETTLING_S
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import Truth, published


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the joints report at the end of a tick; arrays are (6,).

    Attributes:
        q, qd: Measured position [rad] and velocity [rad/s].
        current: Measured motor current [A].
        temperature: [°C].
        current_target: What the servo's model asks for [A].
        moment_target: Torque of the set-point by the controller's model, without friction [N·m].
        true_q, true_qd: Without noise, for those who judge.
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


class Body:
    """One drawn arm, powered or standing on its brakes.

    Args:
        truth: What it is really like.
        rate_hz: Ticks per second.
        q: (6,) where it stands when it is switched on [rad].
        mounted: What really hangs at the flange; what is declared when None.

    Attributes:
        arm: What is published about it.
        braked: Whether the mechanical brakes hold it: nothing moves, no current flows.
        declared: The load the controller believes in.
        deaf: Whether it goes on believing in that, whatever is declared.
    """

    def __init__(
        self,
        truth: Truth,
        rate_hz: float,
        q: FloatArray,
        *,
        mounted: Payload | None = None,
    ) -> None:
        self.arm: ArmDescription = published(truth.arm)
        self.braked = True
        self.declared = Payload()
        self.deaf = False
        self._mounted = mounted
        self._sensors = Sensors(truth)
        self._simulation = Simulation(truth, Setting(rate_hz), q)
        self._simulation.set_payloads(mounted or self.declared, self.declared)
        self._simulation.settle(SETTLING_S)

    @property
    def setpoint(self) -> FloatArray:
        """(3, 6) what the servo follows now."""
        return self._simulation.setpoint

    @property
    def gravity(self) -> tuple[float, float, float]:
        """In the base frame [m/s²]."""
        return self._simulation.setting.gravity

    @property
    def mounted(self) -> Payload:
        """What really hangs at the flange."""
        return self._mounted or self.declared

    def step(self, setpoint: FloatArray) -> Reading:
        """Follow a set-point (3, 6) for one tick; the brakes ignore it."""
        simulation = self._simulation
        if self.braked:
            samples = simulation.stand(1)
        else:
            samples = simulation.advance(setpoint[None])
            if not len(samples):  # it ran away: whoever simulates it stops it here
                self.braked = True
                return self._broken(samples.fault)
        q, qd, current, celsius = (samples[name] for name in ("q", "qd", "current", "celsius"))
        seen = self._sensors.measure(q, qd, current, celsius)
        target = samples["current_target"][0]
        moment = simulation.moment_target if not self.braked else np.zeros_like(target)
        q_seen, qd_seen, current_seen, celsius_seen = (each[0] for each in seen)
        return Reading(
            q_seen, qd_seen, current_seen, celsius_seen, target, moment, q[0], qd[0], samples.fault
        )

    def brake(self) -> None:
        """Let the mechanical brakes hold the arm where it is."""
        self._simulation.engage_brakes()
        self.braked = True

    def release(self) -> None:
        """Let the servo hold the arm where it is."""
        if self.braked:
            self._simulation.engage_brakes()
            self.braked = False

    def declare(self, payload: Payload) -> None:
        """Believe in another load, and mount it unless something else is said to hang there."""
        if self.deaf:
            return
        self.declared = payload
        self._simulation.set_payloads(self.mounted, payload)

    def forget(self) -> None:
        """Believe in no load any more; what hangs at the flange stays there."""
        hanging, self.declared = self.mounted, Payload()
        self._simulation.set_payloads(hanging, self.declared)

    def mount(self, payload: Payload | None) -> None:
        """Hang something to the flange, whatever is declared; None for what is declared."""
        self._mounted = payload
        self._simulation.set_payloads(self.mounted, self.declared)

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (6,) [N·m] act from now on; zeros end it."""
        self._simulation.disturbances.push[:] = torque

    @property
    def pushed(self) -> FloatArray:
        """(6,) the external joint torque that acts [N·m]."""
        return self._simulation.disturbances.push

    def heat(self, joint: int, celsius: float) -> None:
        """Set the temperature of one joint [°C]."""
        self._simulation.joints.states["celsius"][joint] = celsius

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """(6, 6) of the controller's model at `q` (6,) [kg·m²]."""
        return self._simulation.nominal.mass_matrix(q)

    def torque_for(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(6,) what a motion needs by the controller's model, without friction [N·m]."""
        return self._simulation.nominal.inverse(q, qd, qdd)

    def _broken(self, fault: int) -> Reading:
        nan = np.full(self.arm.n_joints, np.nan)
        return Reading(nan, nan, nan, nan, nan, nan, nan, nan, fault)
