"""The arm behind the PLC: set-points of some cycles in, what its drives measured out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.records import SETTLING_S
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import Truth, published


class Measured(NamedTuple):
    """What the drives report of N cycles; arrays are (N, n).

    Attributes:
        q, qd: [rad], [rad/s].
        effort, effort_target: Torque at the joint [N·m] or motor current [A].
        celsius: [°C].
        true_qd: Without noise, for those who judge.
        fault: 0, or a code of `plant.records.FAULTS` that holds for the last cycle.
    """

    q: FloatArray
    qd: FloatArray
    effort: FloatArray
    celsius: FloatArray
    effort_target: FloatArray
    true_qd: FloatArray
    fault: int


class PlcArm:
    """One drawn arm under its servo, or standing on its brakes.

    Args:
        truth: What it is really like.
        rate_hz: Cycles per second.
        q: (n,) where it stands [rad].
        torque: Whether the drives tell torques, by the published constants, or currents.
        mounted: What really hangs at the flange; what is declared when None.

    Attributes:
        published: What its maker says about it.
        braked: Whether the mechanical brakes hold it.
        declared: The load that the PLC computes with.
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
        self.published: ArmDescription = published(truth.arm)
        self.braked = False
        self.declared = Payload()
        self._mounted = mounted
        self._gains = self.published.drive_gains if torque else np.ones(len(q))
        self._sensors = Sensors(truth)
        self._simulation = Simulation(truth, Setting(rate_hz), q)
        self._simulation.set_payloads(mounted or self.declared, self.declared)
        self._simulation.settle(SETTLING_S)

    @property
    def mounted(self) -> Payload:
        """What really hangs at the flange."""
        return self._mounted or self.declared

    @property
    def position(self) -> FloatArray:
        """(n,) true joint position [rad]."""
        return self._simulation.position

    @property
    def speed(self) -> FloatArray:
        """(n,) true joint speed [rad/s]."""
        return self._simulation.speed

    @property
    def setpoint(self) -> FloatArray:
        """(3, n) what the servo follows now."""
        return self._simulation.setpoint

    def advance(self, setpoints: FloatArray) -> Measured:
        """Follow set-points (N, 3, n), one a cycle; fewer come back when the last has a fault."""
        simulation = self._simulation
        samples = simulation.stand(len(setpoints)) if self.braked else simulation.advance(setpoints)
        q, qd, current, celsius = (samples[name] for name in ("q", "qd", "current", "celsius"))
        seen = self._sensors.measure(q, qd, current, celsius)
        target = samples["current_target"]
        return Measured(
            seen[0], seen[1], seen[2] * self._gains, seen[3], target * self._gains, qd,
            samples.fault,
        )  # fmt: skip

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
        """Compute with another load, and mount it unless something else is said to hang there."""
        self.declared = payload
        self._simulation.set_payloads(self.mounted, payload)

    def mount(self, payload: Payload | None) -> None:
        """Hang something to the flange, whatever is declared; None for what is declared."""
        self._mounted = payload
        self._simulation.set_payloads(self.mounted, self.declared)

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        self._simulation.disturbances.push[:] = torque
