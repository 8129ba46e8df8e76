"""Arm with its controller: simulation, sensors, payloads and brakes of one robot.

The embedded mock controller, the mock UR controller and the mock PLC command `ServoArm` by
set-points, and report its measurements in different formats. (The mock CiA 402 drives have no
controller of the whole arm, and therefore use a different class: `cia402.body`.)
"""

from __future__ import annotations

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.records import SETTLING_S
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Samples, Setting, Simulation
from hil_mock_robot.plant.truth import Truth, published


class ServoArm:
    """Arm of one robot, held by its servo or by its mechanical brakes.

    Args:
        truth: True parameters of the arm.
        setting: Rate, integration, gravity and temperature.
        q: (n,) position at power-on [rad].
        mounted: Payload that is mounted at the flange; None for the declared payload.
        declared: Payload in the controller's model at the start; None for no payload.
        wear: Factors on the friction, (n,); None for factors of 1.
        sensors: Sensors of a different arm with the same truth, to continue its noise sequence.

    Attributes:
        published: Published description of the arm.
        simulation: Simulation with the true state, external torques and wear.
        braked: Whether the mechanical brakes hold the arm, without motion and without current.
        declared: Present payload in the controller's model.
    """

    def __init__(
        self,
        truth: Truth,
        setting: Setting,
        q: FloatArray,
        *,
        mounted: Payload | None = None,
        declared: Payload | None = None,
        wear: FloatArray | None = None,
        sensors: Sensors | None = None,
    ) -> None:
        self.published: ArmDescription = published(truth.arm)
        self.braked = False
        self.declared = declared or Payload()
        self._mounted = mounted
        self._sensors = sensors or Sensors(truth)
        self.simulation = Simulation(truth, setting, q)
        self.simulation.set_payloads(self.mounted, self.declared)
        if wear is not None:
            self.simulation.disturbances.wear[:] = wear
        self.simulation.settle(SETTLING_S)

    @property
    def mounted(self) -> Payload:
        """Payload that is mounted at the flange."""
        return self._mounted or self.declared

    @property
    def setpoint(self) -> FloatArray:
        """Position, velocity and acceleration that the servo follows, (3, n)."""
        return self.simulation.setpoint

    @property
    def position(self) -> FloatArray:
        """True joint position (n,) at the end of the last sample [rad]."""
        return self.simulation.position

    @property
    def speed(self) -> FloatArray:
        """True joint speed (n,) at the end of the last sample [rad/s]."""
        return self.simulation.speed

    def follow(self, setpoints: FloatArray) -> Samples:
        """Follow set-points (N, 3, n), one per sample; an arm with closed brakes ignores them.

        Returns:
            True state of up to N samples. If a fault occurs, the last sample has the fault.
        """
        if self.braked:
            return self.simulation.stand(len(setpoints))
        return self.simulation.advance(setpoints)

    def measure(self, samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return measured position [rad], velocity [rad/s], current [A], temperature [°C], (N, n).

        Every sample must be measured exactly once and in order, because the noise depends on the
        order.
        """
        q, qd, current, celsius = (samples[name] for name in ("q", "qd", "current", "celsius"))
        return self._sensors.measure(q, qd, current, celsius)

    def brake(self) -> None:
        """Close the mechanical brakes at the current position."""
        self.simulation.engage_brakes()
        self.braked = True

    def release(self) -> None:
        """Open the mechanical brakes; the servo holds the current position."""
        if self.braked:
            self.simulation.engage_brakes()
            self.braked = False

    def declare(self, payload: Payload) -> None:
        """Change the payload of the controller's model; mount it unless `mounted` is set."""
        self.declared = payload
        self.simulation.set_payloads(self.mounted, payload)

    def mount(self, payload: Payload | None) -> None:
        """Mount a payload independent of the declared payload; None for the declared payload."""
        self._mounted = payload
        self.simulation.set_payloads(self.mounted, self.declared)

    def push(self, torque: FloatArray) -> None:
        """Apply an external joint torque (n,) [N·m] from now on; zeros end it."""
        self.simulation.disturbances.push[:] = torque
