"""One drawn arm as its controller has it: the simulation, the sensors, the loads, the brakes.

The embedded mock controller, the mock UR controller and the mock PLC command `ServoArm` by
set-points and report its measurements in their own ways. (The mock CiA 402 drives have no
controller of the whole arm, and thus an arm of their own: `cia402.body`.)
"""

from __future__ import annotations

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.records import SETTLING_S
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Samples, Setting, Simulation
from hil_mock_robot.plant.truth import Truth, published


class ServoArm:
    """One drawn arm, held by its servo or by its mechanical brakes.

    Args:
        truth: Its true parameters.
        setting: Rate, integration, gravity and temperature.
        q: (n,) where it stands when it is switched on [rad].
        mounted: The load that really hangs at the flange; the declared one when None.
        declared: The load that the controller computes with at the start; none when None.
        wear: (n,) factors of the friction; 1 when None.
        sensors: Those of another arm with the same truth, to go on with its noise.

    Attributes:
        published: Its published description.
        simulation: True state, pushes and wear.
        braked: Whether the mechanical brakes hold it: nothing moves, no current flows.
        declared: The load that the controller computes with.
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
        """The load that really hangs at the flange."""
        return self._mounted or self.declared

    @property
    def setpoint(self) -> FloatArray:
        """(3, n) position, velocity and acceleration that the servo follows."""
        return self.simulation.setpoint

    @property
    def position(self) -> FloatArray:
        """(n,) true joint position [rad]."""
        return self.simulation.position

    @property
    def speed(self) -> FloatArray:
        """(n,) true joint speed [rad/s]."""
        return self.simulation.speed

    def follow(self, setpoints: FloatArray) -> Samples:
        """Follow set-points (N, 3, n), one per sample; closed brakes ignore them.

        Returns:
            True state. Fewer than N samples come back when the last of them has a fault.
        """
        if self.braked:
            return self.simulation.stand(len(setpoints))
        return self.simulation.advance(setpoints)

    def measure(self, samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return measured position [rad], velocity [rad/s], current [A], temperature [°C], (N, n).

        Every sample is to be measured once, in order: the noise of the sensors depends on that.
        """
        q, qd, current, celsius = (samples[name] for name in ("q", "qd", "current", "celsius"))
        return self._sensors.measure(q, qd, current, celsius)

    def brake(self) -> None:
        """Close the mechanical brakes where the arm is."""
        self.simulation.engage_brakes()
        self.braked = True

    def release(self) -> None:
        """Let the servo hold the arm where the brakes have held it."""
        if self.braked:
            self.simulation.engage_brakes()
            self.braked = False

    def declare(self, payload: Payload) -> None:
        """Compute with another load, which is mounted as well unless `mounted` was given."""
        self.declared = payload
        self.simulation.set_payloads(self.mounted, payload)

    def mount(self, payload: Payload | None) -> None:
        """Mount a load whatever is declared; None for the declared one."""
        self._mounted = payload
        self.simulation.set_payloads(self.mounted, self.declared)

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        self.simulation.disturbances.push[:] = torque
