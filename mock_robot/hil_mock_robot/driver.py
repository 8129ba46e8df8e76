"""The embedded mock robot: a whole robot in this process, on a virtual clock.

MuJoCo and numba load on `connect`; until then only names, rates and limits are known.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.errors import CommandRefused, PluginError, RobotConnectionError, RobotFault
from hil.robot import Capabilities, Identity, Limits, Payload, Segment, Status, state_dtype
from hil.typing import FloatArray, StructArray
from hil_mock_robot.draw import published
from hil_mock_robot.motion import Motion
from hil_mock_robot.options import (
    mount_of,
    mounted_of,
    options_of,
    require_same_mount,
    require_short_block,
    start_of,
    truth_of,
)
from hil_mock_robot.records import timing_of
from hil_mock_robot.sensors import Sensors
from hil_mock_robot.truth import Truth

if TYPE_CHECKING:
    from hil_mock_robot.simulation import Samples, Simulation

EPOCH_S = 1_767_225_600.0
"""Host time at which every mock robot is switched on: 2026-01-01 00:00 UTC."""
SETTLING_S = 1.0
MODE_POSITION, MODE_TORQUE = 0, 1
RUNAWAY = 3
FAULTS = {
    1: "protective stop: a joint is more than 0.2 rad away from its set-point",
    2: "protective stop: a joint is at its torque limit",
    RUNAWAY: "the simulated arm runs away",
}


class MockRobot:
    """A robot of `hil` that exists only here; implements `hil.robot.Robot`.

    Time advances only when it is read. The same seed, options and calls give the same bytes.
    Beside the protocol it can be pushed, worn and driven by torque, for tests of what hil does
    about that.

    Args:
        name: The robot's name in the station file.
        model: A built-in arm.
        options: See `hil_mock_robot.options.Options`.

    Raises:
        PluginError: MuJoCo or numba is not installed.
        SpecError: There is no such arm, or an option cannot be.
    """

    def __init__(self, name: str, model: str = "ur5", **options: Any) -> None:
        _require_extra()
        self._name = name
        self._options = options_of(options)
        self._truth = truth_of(model, self._options)
        self._arm = published(self._truth.arm)
        self._rate = self._options.rate_hz or self._arm.rate_hz
        timing_of(self._rate, self._options.substep_hz)
        require_short_block(self._options, self._rate)
        self._motion = Motion(self.limits, self._rate, start_of(self._arm, self._options))
        self._sensors = Sensors(self._truth)
        self._declared = Payload()
        self._mounted = mounted_of(self._options)
        self._gravity = mount_of(self._options)
        self._simulation: Simulation | None = None
        self._connected = False
        self._fault = 0
        # stop() may come from another thread than read(); a block takes well under 10 ms.
        self._lock = threading.RLock()

    @property
    def truth(self) -> Truth:
        """What this robot is really like."""
        return self._truth

    @property
    def identity(self) -> Identity:
        """Model and a serial number made of name, profile and seed."""
        self._require_connection()
        truth = self._truth
        return Identity(
            model=truth.arm,
            serial=f"{self._name}-{truth.profile}-{truth.seed}",
            firmware=f"mock ranges {truth.ranges}",
            driver="mock",
            details={
                "profile": truth.profile,
                "substep_hz": f"{self._options.substep_hz:g}",
                "gravity_m_s2": " ".join(f"{g:g}" for g in self._gravity),
            },
        )

    @property
    def capabilities(self) -> Capabilities:
        """Nominal gains and the rate; the clock is virtual."""
        return Capabilities(
            joint_names=self._arm.joint_names,
            rate_hz=self._rate,
            effort_kind="current",
            drive_gains=tuple(self._arm.drive_gains.tolist()),
            drive_gains_source=self._arm.sources.get("drive_gains", "nominal"),
            clock="virtual",
        )

    @property
    def limits(self) -> Limits:
        """The published limits of the arm."""
        arm = self._arm
        return Limits(
            arm.q_min, arm.q_max, arm.qd_max, arm.qdd_max, arm.effort_max, arm.payload_max_kg
        )

    def connect(self) -> None:
        """Switch the robot on, or clear its fault; does nothing when connected without one."""
        if self._simulation is None or self._fault == RUNAWAY:
            # Outside the lock: the first one compiles for seconds and stop() must not wait.
            built = self._switch_on()
        else:
            built = self._simulation
        with self._lock:
            if self._fault:
                built.engage_brakes()
                self._motion.coast(built.position, built.speed)
            self._simulation, self._fault, self._connected = built, 0, True

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Be mounted as the station says.

        Raises:
            SpecError: The option `mount` says otherwise.
            CommandRefused: The robot is switched on already.
        """
        if self._simulation is not None:
            raise CommandRefused("the mount cannot change once the mock robot is switched on")
        require_same_mount(self._options, gravity_m_s2)
        self._gravity = gravity_m_s2

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a load and, unless `mounted_payload` says otherwise, mount it.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
        """
        with self._lock:
            simulation = self._require_connection()
            if not 0 <= payload.mass <= self._arm.payload_max_kg:
                raise CommandRefused(
                    f"payload of {payload.mass:g} kg: the {self._arm.name} carries "
                    f"0 to {self._arm.payload_max_kg:g} kg",
                    hint="declare a lighter load",
                )
            if self._motion.moving:
                raise CommandRefused("the payload cannot change in motion", hint="stop() first")
            self._declared = payload
            simulation.set_payloads(self._mounted or payload, payload)
            return payload

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It starts elsewhere, moves at its ends, or leaves the limits.
        """
        with self._lock:
            self._require_connection()
            self._motion.prepare(segment)

    def start(self) -> None:
        """Begin the prepared segment with the next sample.

        Raises:
            CommandRefused: Nothing is prepared, or a segment is still running.
        """
        with self._lock:
            self._require_connection()
            self._motion.start()

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Simulate up to `block` samples, not past the end of the running segment.

        Each set-point of a segment gives one row. A fault ends the block with a row that says
        so; the next call raises.

        Raises:
            RobotFault: Protective stop; `connect` clears it.
        """
        with self._lock:
            simulation = self._require_connection()
            if self._fault:
                raise self._protective_stop()
            if np.isfinite(simulation.disturbances.torque).any():
                return self._read_in_torque_control(simulation)
            setpoints, status = self._motion.take(self._options.block)
            first = simulation.samples
            samples = simulation.advance(setpoints)
            rows = self._rows_of(samples, first)
            done = len(rows)
            rows["status"] = status[:done]
            for k, field in enumerate(("q_target", "qd_target", "qdd_target")):
                rows[field] = setpoints[:done, k]
            rows["effort_target"] = samples["current_target"]
            return self._with_fault(rows, samples)

    def stop(self) -> None:
        """Decelerate along the present path with half the acceleration limit, then hold."""
        with self._lock:
            if self._simulation is None:
                return
            if np.isfinite(self._simulation.disturbances.torque).any():
                self.command_torque(None)
            self._motion.brake()

    def close(self) -> None:
        """Stop and disconnect; the robot stays where it is and `connect` finds it again."""
        with self._lock:
            self.stop()
            self._connected = False

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        with self._lock:
            self._require_connection().disturbances.push[:] = torque

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale all friction by `factor` (n,) from now on, 1 for as good as new."""
        with self._lock:
            self._require_connection().disturbances.wear[:] = factor

    def command_torque(self, torque: Sequence[float] | FloatArray | None) -> None:
        """Drive the joints by torque (n,) [N·m] instead of position; None brakes and holds.

        The torque goes through the drive's nominal gain and compensates nothing, gravity included.
        """
        with self._lock:
            simulation = self._require_connection()
            if torque is not None:
                self._motion.brake()
                simulation.disturbances.torque[:] = torque
                return
            simulation.disturbances.torque[:] = np.nan
            simulation.track(simulation.position, simulation.speed)
            self._motion.coast(simulation.position, simulation.speed)

    def _switch_on(self) -> Simulation:
        from hil_mock_robot.simulation import Setting, Simulation

        options = self._options
        setting = Setting(self._rate, options.substep_hz, self._gravity, options.temperature_c)
        simulation = Simulation(self._truth, setting, start_of(self._arm, options))
        simulation.set_payloads(self._mounted or self._declared, self._declared)
        simulation.settle(SETTLING_S)
        return simulation

    def _require_connection(self) -> Simulation:
        if not self._connected or self._simulation is None:
            raise RobotConnectionError(
                f"mock robot {self._name} is not connected", hint="call connect() first"
            )
        return self._simulation

    def _read_in_torque_control(self, simulation: Simulation) -> StructArray:
        simulation.track(simulation.position, np.zeros(self._arm.n_joints))
        held = np.repeat(simulation.setpoint[None], self._options.block, axis=0)
        first = simulation.samples
        samples = simulation.advance(held)
        rows = self._rows_of(samples, first)
        rows["status"], rows["mode"] = int(Status.MOVING), MODE_TORQUE
        for field in ("q_target", "qd_target", "qdd_target"):
            rows[field] = np.nan
        rows["effort_target"] = simulation.disturbances.torque / self._arm.drive_gains
        return self._with_fault(rows, samples)

    def _rows_of(self, samples: Samples, first: int) -> StructArray:
        """Rows with everything that is measured."""
        rows = np.zeros(len(samples), dtype=state_dtype(self._arm.n_joints))
        rows["device_time"] = (first + 1 + np.arange(len(rows))) / self._rate
        rows["host_time"] = EPOCH_S + rows["device_time"]
        rows["segment"] = self._motion.segment
        measured = self._sensors.measure(
            samples["q"], samples["qd"], samples["current"], samples["celsius"]
        )
        rows["q"], rows["qd"], rows["effort"], rows["temperature"] = measured
        return rows

    def _protective_stop(self) -> RobotFault:
        return RobotFault(
            f"{self._name}: {FAULTS[self._fault]}", hint="find the cause, then reconnect"
        )

    def _with_fault(self, rows: StructArray, samples: Samples) -> StructArray:
        self._fault = samples.fault
        if self._fault and not len(rows):
            raise self._protective_stop()
        if self._fault:
            rows["status"][-1:] |= int(Status.FAULT | Status.MASKED)
            rows["fault_code"][-1:] = self._fault
        return rows


def _require_extra() -> None:
    missing = [name for name in ("mujoco", "numba") if find_spec(name) is None]
    if missing:
        raise PluginError(
            f"the mock robot needs {' and '.join(missing)}", hint='pip install "hil[mock]"'
        )
