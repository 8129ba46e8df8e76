"""The arm and the servo controller that moves it: commands, faults, brakes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray
from hil.robot import Limits
from hil_mock_robot.draw import published
from hil_mock_robot.motion import BRAKING_SHARE, Motion
from hil_mock_robot.mounting import mount_of, mounted_of, require_same_mount
from hil_mock_robot.options import Options, start_of
from hil_mock_robot.records import timing_of
from hil_mock_robot.today import truth_of, wear_of

if TYPE_CHECKING:
    from hil_mock_robot.simulation import Simulation

SETTLING_S = 1.0
RUNAWAY, PROTECTIVE_STOP, EMERGENCY_STOP, WATCHDOG = 3, 4, 5, 6
FAULTS = {
    1: "protective stop: a joint is more than 0.2 rad away from its set-point",
    2: "protective stop: a joint is at its torque limit",
    RUNAWAY: "the simulated arm runs away",
    PROTECTIVE_STOP: "protective stop, injected",
    EMERGENCY_STOP: "emergency stop, injected",
    WATCHDOG: "stopped by the controller's watchdog: nobody read it while it moved",
}
FAULT_KINDS = {
    1: "tracking",
    2: "overload",
    RUNAWAY: "runaway",
    PROTECTIVE_STOP: "protective_stop",
    EMERGENCY_STOP: "emergency_stop",
    WATCHDOG: "watchdog",
}
"""One word for each fault, for the journal."""
FULL_BRAKES = 1.0
"""Share of the acceleration limit of an emergency stop."""


class Arm:
    """One drawn robot, before and after it is switched on.

    Args:
        model: A built-in arm.
        options: What the station says.

    Attributes:
        truth: What it is really like.
        description: What is published about it.
        rate_hz: Samples per second.
        motion: What its controller plays back.
        gravity: In the base frame [m/s²].
        simulation: None until it is switched on.
        fault: 0, or a code of `FAULTS` until `switch_on`.
        locked: Whether the mechanical brakes hold it.

    Raises:
        SpecError: There is no such arm, or an option cannot be.
    """

    def __init__(self, model: str, options: Options) -> None:
        self.truth = truth_of(model, options)
        self.description = published(self.truth.arm)
        self.rate_hz = options.rate_hz or self.description.rate_hz
        timing_of(self.rate_hz, options.substep_hz)
        self._options, self.day = options, options.day
        self._wear = wear_of(options, self.description.n_joints)
        self.motion = Motion(self.limits, self.rate_hz, start_of(self.description, options))
        self._declared = Payload()
        self._mounted = mounted_of(options)
        self.gravity = mount_of(options)
        self.simulation: Simulation | None = None
        self.fault = 0
        self.locked = False

    @property
    def limits(self) -> Limits:
        """The published limits."""
        arm = self.description
        return Limits(
            arm.q_min, arm.q_max, arm.qd_max, arm.qdd_max, arm.effort_max, arm.payload_max_kg
        )

    @property
    def on(self) -> Simulation:
        """The simulation of an arm that is switched on."""
        assert self.simulation is not None
        return self.simulation

    @property
    def device_time(self) -> float:
        """The controller's clock [s]."""
        return self.simulation.samples / self.rate_hz if self.simulation else 0.0

    @property
    def fastest(self) -> float:
        """True speed of the fastest joint [rad/s]."""
        return float(np.abs(self.simulation.speed).max()) if self.simulation else 0.0

    @property
    def dead(self) -> bool:
        """Whether the simulation itself has broken down: no more samples until `switch_on`."""
        return self.fault == RUNAWAY

    @property
    def moving(self) -> bool:
        """Whether its controller commands a motion."""
        return self.motion.moving or self.torque_controlled

    @property
    def torque_controlled(self) -> bool:
        """Whether a torque is commanded in place of positions."""
        return bool(np.isfinite(self.on.disturbances.torque).any())

    def build(self) -> Simulation:
        """A simulation to switch on: the one there is, or a new one, which takes its time."""
        if self.simulation is not None and not self.dead:
            return self.simulation
        from hil_mock_robot.simulation import Setting, Simulation

        options = self._options
        setting = Setting(self.rate_hz, options.substep_hz, self.gravity, options.temperature_c)
        simulation = Simulation(self.truth, setting, start_of(self.description, options))
        simulation.set_payloads(self._mounted or self._declared, self._declared)
        simulation.disturbances.wear[:] = self._wear
        simulation.settle(SETTLING_S)
        return simulation

    def switch_on(self, simulation: Simulation) -> None:
        """Work with what `build` returned, and clear a fault."""
        if self.fault:
            simulation.engage_brakes()
            self.motion.coast(simulation.position, simulation.speed)
        self.simulation, self.fault, self.locked = simulation, 0, False

    def mount(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Be mounted as the station says.

        Raises:
            SpecError: The option `mount` says otherwise.
            CommandRefused: The robot is switched on already.
        """
        if self.simulation is not None:
            raise CommandRefused("the mount cannot change once the mock robot is switched on")
        require_same_mount(self._options, gravity_m_s2)
        self.gravity = gravity_m_s2

    def set_payload(self, payload: Payload) -> None:
        """Declare a load and, unless `mounted_payload` says otherwise, mount it.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
        """
        arm = self.description
        if not 0 <= payload.mass <= arm.payload_max_kg:
            raise CommandRefused(
                f"payload of {payload.mass:g} kg: the {arm.name} carries "
                f"0 to {arm.payload_max_kg:g} kg",
                hint="declare a lighter load",
            )
        if self.motion.moving:
            raise CommandRefused("the payload cannot change in motion", hint="stop() first")
        self._declared = payload
        self.on.set_payloads(self._mounted or payload, payload)

    def brake(self) -> None:
        """Decelerate along the present path with half the acceleration limit, then hold."""
        if self.torque_controlled:
            self.command_torque(None)
        if not self.fault:
            self.motion.brake()

    def trip(self, fault: int) -> None:
        """Stop by a fault of the controller's own (a code of `FAULTS`)."""
        if self.fault:
            return
        if self.torque_controlled:
            self.command_torque(None)
        self.motion.brake(FULL_BRAKES if fault == EMERGENCY_STOP else BRAKING_SHARE)
        self.fault = fault

    def lock(self, fault: int) -> None:
        """Engage the mechanical brakes: the servo has failed at its task (a code of `FAULTS`)."""
        self.fault, self.locked = fault, True
        if not self.dead:
            self.on.engage_brakes()
            self.on.disturbances.torque[:] = np.nan
            self.motion.coast(self.on.position, self.on.speed)

    def command_torque(self, torque: FloatArray | None) -> None:
        """Drive the joints by torque (n,) [N·m]; None brakes and holds."""
        simulation = self.on
        if torque is not None:
            self.motion.brake()
            simulation.disturbances.torque[:] = torque
            return
        simulation.disturbances.torque[:] = np.nan
        simulation.track(simulation.position, simulation.speed)
        self.motion.coast(simulation.position, simulation.speed)
