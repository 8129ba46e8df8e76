"""Simulated UR controller without sockets and without wall time, advanced tick by tick.

`Machine` contains the arm, the modes, the active `Program` and the motion that moves the arm. The
outputs of `Machine` are the state that clients receive. After every tick, `Publishing` updates the
outputs for joints, modes and supply, and `Cartesian` the outputs that need kinematics: TCP, elbow,
accelerometer and wrench. Quantities that the plant does not simulate have simple, plausible values
(docs/reference/mock-ur-rtde.md, docs/reference/mock-ur-motions.md).

`HeatGuard` stops an arm that is too hot. Source of the temperature limits and codes: Universal
Robots, error codes C62A1 (joint temperature high) and C62A11 (joint temperature, shut down). At the
shut-down limit, the real arm switches the joint off, whereas the mock triggers a protective stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.linalg.lapack import dposv

from hil.core import FloatArray
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.ur.body import Body, Reading
from hil_mock_robot.ur.kinematics import (
    Frame,
    Posture,
    Triple,
    compose,
    frame_of,
    inverted,
    lengths_of,
    pose_from,
    turned,
    twist_of,
)
from hil_mock_robot.ur.modes import (
    JOINT_BOOTING,
    JOINT_FAULT,
    JOINT_IDLE,
    JOINT_POWER_OFF,
    JOINT_RUNNING,
    SAFETY_BITS,
    Modes,
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from hil_mock_robot.ur.motion import Motion, Setpoint, StopJoints
from hil_mock_robot.ur.motion_limits import MotionImpossible, joint_leaving_range, out_of_range
from hil_mock_robot.ur.rtde_variables import Series, Values, inputs_of, outputs_of
from hil_mock_robot.ur.rtde_wire import Line

PROTECTIVE_STOP_RAD_S2 = 8.0
EMERGENCY_STOP_RAD_S2 = 16.0
PROGRAM_STOP_RAD_S2 = 8.0


@dataclass(frozen=True, slots=True)
class Place:
    """Position in the text of a program.

    Attributes:
        line, column: Line and column, from 1; column 1 if it is unknown.
        token: Program text at this position; `""` for a message without a position.
    """

    line: int = 1
    column: int = 1
    token: str = ""


NOWHERE = Place()


@dataclass(frozen=True, slots=True)
class Event:
    """Event for the primary interface and the journal.

    Attributes:
        kind: Kind of the event: `program_started`, `program_stopped`, `protective_stop`,
            `emergency_stop`, `popup`, `error`, `text`, `refused`, …
        name: Name of the program, or of another subject of the event.
        text: Description for the user.
        code: Error code C… of UR; 0 for none.
        place: Position in the text of the program at which the event occurred.
    """

    kind: str
    name: str = ""
    text: str = ""
    code: int = 0
    place: Place = NOWHERE


@dataclass(slots=True)
class Watchdog:
    """Watchdog of URScript: action if an input is not written for a number of ticks."""

    variable: str
    ticks: int
    action: str


class Program(Protocol):
    """Robot program, which is called in each tick while it plays.

    Attributes:
        name: Name in the `def` of the program.
    """

    name: str

    def begin(self, machine: Machine) -> None:
        """Prepare the program for its first tick."""

    def tick(self, machine: Machine) -> bool:
        """Execute one tick of the program; return False once the program is over."""

    def end(self, machine: Machine) -> None:
        """Clean up at the end of the program or at a stop; the machine brakes an active motion."""


class Machine:
    """Simulated UR controller and its arm; for use by one thread.

    Args:
        series: Generation and software of the controller.
        body: Simulated arm.
        serial: Serial number of the arm: digits only.
        powered: Whether the arm is switched on and its brakes are released.

    Attributes:
        inputs, outputs: Present values of the RTDE inputs and outputs.
        modes: Present robot mode and safety mode.
        ticks: Number of ticks since the controller was switched on.
        tcp: Tool centre point in the flange frame, (6,): metres and rotation vector.
        program: Playing or paused program; None if no program plays or is paused.
        runtime: Runtime state of the program, as in RTDE `runtime_state`.
        motion: Active motion; None if the set-point is at rest.
        reading: Latest reading of the joints.
        written: Map from input to the tick of the last write to this input.
        watchdog: Watchdog set by the playing program.
        speed_fraction: Position of the speed slider, 0 to 1.
        listeners: Functions that are called with every `Event`.
        watches: Map from input to a function that is called with the value when a client writes the
            input.
        mishaps: Recorder of internal errors of the mock in programs and motions.
    """

    def __init__(self, series: Series, body: Body, *, serial: str, powered: bool = True) -> None:
        self.series, self.body, self.serial = series, body, serial
        self.tick_s = 1.0 / series.rate_hz
        self.inputs: Values = inputs_of(series)
        self.outputs: Values = outputs_of(series)
        self.modes = Modes(self.tick_s, powered=powered)
        self.ticks = 0
        self.tcp: FloatArray = np.zeros(6)
        self.program: Program | None = None
        self.runtime = RuntimeState.STOPPED
        self.motion: Motion | None = None
        self.written: dict[str, int] = {}
        self.watchdog: Watchdog | None = None
        self.speed_fraction = 1.0
        self.listeners: list[Callable[[Event], None]] = []
        self.watches: dict[str, Callable[[Any], None]] = {}
        self.line, self.mishaps = Line(self.tick_s), Mishaps()
        if powered:
            body.release()
        self.setpoint: Setpoint = body.setpoint
        self._heat, self._publishing = HeatGuard(), Publishing(self)
        self.reading: Reading = body.step(self.setpoint)
        self._publishing.publish(self)

    @property
    def now_s(self) -> float:
        """Controller time: RTDE `timestamp` [s]."""
        return self.ticks * self.tick_s

    def tick(self) -> None:
        """Simulate one tick of device time of the controller."""
        self.ticks += 1
        self.modes.tick()
        self._power()
        self._guard()
        if self.program is not None and self.runtime is RuntimeState.PLAYING:
            self._play_on(self.program)
        self._advance()
        self.reading = self.body.step(self.setpoint)
        if self.reading.fault:
            self.protective_stop(self.reading.fault, by_servo=False)
        self._heat.look(self)
        self._publishing.publish(self)

    def write(self, name: str, value: Any) -> None:
        """Write an RTDE input on behalf of a client."""
        self.inputs[name] = value
        self.outputs.offer(name, value)
        self.written[name] = self.ticks
        if name in self.watches:
            self.watches[name](value)

    def move(self, motion: Motion | None) -> None:
        """Replace the active motion; None keeps the set-point at its position."""
        self.motion = motion

    def play(self, program: Program) -> bool:
        """Stop the present program and play `program`; return whether the arm is running."""
        self.halt()
        if not self.modes.running:
            self.tell("refused", program.name, "the arm is not running")
            return False
        self.program, self.runtime = program, RuntimeState.PLAYING
        self.tell("program_started", program.name)
        program.begin(self)
        return True

    def halt(self) -> None:
        """End the program and bring an active motion to rest."""
        program, self.program = self.program, None
        self.runtime, self.watchdog = RuntimeState.STOPPED, None
        if program is not None:
            program.end(self)
            self.tell("program_stopped", program.name)
        if self.motion is not None and not isinstance(self.motion, StopJoints):
            self.motion = StopJoints(PROGRAM_STOP_RAD_S2, self.tick_s)

    def pause(self) -> None:
        """Pause the playing program."""
        if self.runtime is RuntimeState.PLAYING:
            self.runtime = RuntimeState.PAUSED

    def resume(self) -> None:
        """Resume a paused program if the arm is running."""
        if self.runtime is RuntimeState.PAUSED and self.modes.running:
            self.runtime = RuntimeState.PLAYING

    def protective_stop(self, code: int, *, by_servo: bool = True, text: str = "") -> None:
        """Trigger a protective stop.

        Args:
            code: Code of `plant.records.FAULTS`, or an error code of UR.
            by_servo: Whether the servo stops the arm; otherwise the mechanical brakes do.
            text: Description of the stop, if the code alone does not identify the cause.
        """
        first = self.modes.running
        self.modes.protective_stop(code)
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, by_servo=by_servo)
        if first:
            self.tell("protective_stop", text=text, code=code)

    def emergency_stop(self) -> None:
        """Trigger an emergency stop of the robot: end the program and brake the arm."""
        self.modes.emergency_stop()
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, by_servo=True)
        self.tell("emergency_stop")

    def safeguard_stop(self) -> None:
        """Trigger a safeguard stop: the program pauses, and the servo keeps the arm in position."""
        if not self.modes.cause("safeguard stop"):
            return
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, by_servo=True)
        self.tell("safeguard_stop")

    def fault(self, code: int = 0) -> None:
        """Simulate a fault of the safety system: stop the arm, then switch its power off."""
        self.modes.fault(code)
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, by_servo=True)
        self.tell("fault", code=code)

    def cut_power(self) -> None:
        """Simulate a power failure: the mechanical brakes stop the arm immediately."""
        self.halt()
        self._lock()
        self.reading = self.body.step(self.setpoint)
        self.tell("power_cut")

    def boot(self, *, powered: bool) -> None:
        """Restart the controller after `cut_power`.

        The clock starts at 0, no payload is declared, and no program is loaded.
        """
        self.inputs, self.outputs = inputs_of(self.series), outputs_of(self.series)
        remote = self.modes.remote
        self.modes = Modes(self.tick_s, powered=powered)
        self.modes.remote = remote
        self.ticks, self.written, self.tcp = 0, {}, np.zeros(6)
        self.speed_fraction = 1.0
        self.body.forget()
        self.setpoint = self.body.setpoint
        # New objects, because the old ones store state from before the restart.
        self._heat, self._publishing = HeatGuard(), Publishing(self)
        self._publishing.publish(self)
        self.tell("booted")

    def fail(self, text: str, code: int = 0, place: Place = NOWHERE) -> None:
        """End the program with a runtime error."""
        self.tell("error", self.program.name if self.program else "", text, code, place)
        self.halt()

    def tell(
        self, kind: str, name: str = "", text: str = "", code: int = 0, place: Place = NOWHERE
    ) -> None:
        """Send an event to all listeners."""
        event = Event(kind, name, text, code, place)
        for listener in self.listeners:
            listener(event)

    def _play_on(self, program: Program) -> None:
        """Execute one tick of the program; an internal error of the mock ends only this program."""
        try:
            plays = program.tick(self)
        except Exception as error:
            self.fail(f"the program cannot continue: {self.mishaps.met(error, 'a program')}")
            return
        if not plays:
            self.halt()

    def _power(self) -> None:
        """Release or close the brakes according to the robot mode."""
        on = self.modes.robot is RobotMode.RUNNING
        if on and self.body.braked and self.modes.running:
            self.body.release()
            self.setpoint = self.body.setpoint
        elif not on and not self.body.braked:
            self.halt()
            self._lock()

    def _guard(self) -> None:
        """Check the watchdog that a program has set, and execute its action if it has expired."""
        dog = self.watchdog
        if dog is None or self.ticks - self.written.get(dog.variable, 0) <= dog.ticks:
            return
        self.tell("watchdog", dog.variable, f"not written in time: {dog.action}")
        self.watchdog = None
        if dog.action == "stop":
            self.halt()
        elif dog.action == "pause":
            self.pause()

    def _advance(self) -> None:
        if self.body.braked or self.motion is None:
            return
        if self.runtime is RuntimeState.PAUSED and not isinstance(self.motion, StopJoints):
            self.motion = StopJoints(PROGRAM_STOP_RAD_S2, self.tick_s)
        try:
            after = self.motion.advance(self.setpoint, self.speed_fraction)
        except MotionImpossible as error:
            after = self._break_off(error).advance(self.setpoint, self.speed_fraction)
        except Exception as error:
            why = f"the motion cannot continue: {self.mishaps.met(error, 'a motion')}"
            after = self._break_off(MotionImpossible(why)).advance(self.setpoint, 1.0)
        if after is None:
            self.motion = None
            self.setpoint = np.stack((self.setpoint[0], np.zeros(6), np.zeros(6)))
        else:
            self.setpoint = after
            joint = joint_leaving_range(self.body.arm, after[0], after[1])
            if joint is not None and self.modes.running:
                self._break_off(out_of_range(self.body.arm, joint))

    def _break_off(self, error: MotionImpossible) -> StopJoints:
        """Stop after a motion error, by a protective stop or by a runtime error of the program."""
        if error.code:
            self.protective_stop(error.code, text=error.text)
        else:
            self.fail(error.text)
        self.motion = StopJoints(PROTECTIVE_STOP_RAD_S2, self.tick_s)
        return self.motion

    def _come_to_rest(self, deceleration: float, *, by_servo: bool) -> None:
        if not by_servo:
            self._lock()
        elif self.motion is not None:
            self.motion = StopJoints(deceleration, self.tick_s)

    def _lock(self) -> None:
        self.motion = None
        self.body.brake()
        self.setpoint = self.body.setpoint


HIGH_C, SHUT_DOWN_C = 80.0, 85.0

COOLED_K = 2.0
"""Amount [K] by which a temperature must fall below the limits before a high temperature is
reported again."""

CODE = 62


class HeatGuard:
    """Monitor of the measured joint temperatures, called once per tick."""

    def __init__(self) -> None:
        self._high = False

    def look(self, machine: Machine) -> None:
        """Warn once at a high temperature, and stop the arm while a joint is too hot."""
        celsius = machine.reading.temperature
        hottest = float(celsius.max())
        if hottest < HIGH_C - COOLED_K:
            self._high = False
        elif hottest >= HIGH_C and not self._high:
            self._high = True
            joint = int(celsius.argmax()) + 1
            machine.tell("text", "C62A1", f"joint {joint}: temperature high, {hottest:.0f} °C")
        if hottest >= SHUT_DOWN_C and machine.modes.running:
            joint = int(celsius.argmax()) + 1
            machine.protective_stop(CODE)
            machine.tell("text", "C62A11", f"joint {joint}: too hot, {hottest:.0f} °C")


SUPPLY_V = 48.0

STANDBY_A = 0.5
"""Current that control box and joint electronics draw from the 48 V supply [A]."""

WINDING_OHM = 1.0
"""Resistance of each motor with its amplifier, a typical value [Ω]."""

EXECUTION_MS = 0.35
"""Constant value of `actual_execution_time`, independent of the simulating computer [ms]."""

DEVIATION_RAD = 0.1
"""Distance of actual from target position at which `joint_position_deviation_ratio` is 1 [rad]."""

CURRENT_WINDOW_A = 2.0
POWER_ON, PROGRAM_RUNNING = 1, 2
TOOL_RUNNING, TOOL_IDLE = 253, 255

JOINT_MODES = {
    RobotMode.RUNNING: JOINT_RUNNING,
    RobotMode.IDLE: JOINT_IDLE,
    RobotMode.POWER_ON: JOINT_IDLE,
    RobotMode.BOOTING: JOINT_BOOTING,
}


class Publishing:
    """Updates of the RTDE outputs of one machine.

    Outputs for modes and payload are written only after a change.
    """

    def __init__(self, machine: Machine) -> None:
        self._cartesian = Cartesian(machine)
        self._before: tuple[object, ...] = ()
        self._payload: object = None

    def publish(self, machine: Machine) -> None:
        """Update the outputs after a tick."""
        out, seen = machine.outputs, machine.reading
        out["timestamp"] = machine.now_s
        for name, values in zip(
            ("target_q", "target_qd", "target_qdd"), machine.setpoint, strict=True
        ):
            out[name] = values.tolist()
        out["target_current"] = seen.current_target.tolist()
        out["target_moment"] = seen.moment_target.tolist()
        out["actual_q"], out["actual_qd"] = seen.q.tolist(), seen.qd.tolist()
        out["actual_current"] = out["joint_control_output"] = seen.current.tolist()
        out["joint_temperatures"] = celsius = seen.temperature.tolist()
        out["tool_temperature"] = celsius[-1]
        if "joint_position_deviation_ratio" in out:
            apart = float(np.abs(machine.setpoint[0] - seen.q).max())
            out["joint_position_deviation_ratio"] = apart / DEVIATION_RAD
        self._publish_modes(machine)
        self._publish_load(machine)
        self._cartesian.publish(machine)
        out["actual_robot_current"] = _supply_current(machine)
        out["actual_momentum"] = _momentum(machine)

    def _publish_modes(self, machine: Machine) -> None:
        out, modes = machine.outputs, machine.modes
        moving = machine.motion is not None and np.abs(machine.setpoint[1]).max() > 0
        playing = machine.runtime is RuntimeState.PLAYING
        out["speed_scaling"] = 1.0 if moving or playing else 0.0
        out["target_speed_fraction"] = machine.speed_fraction
        now = modes.robot, modes.safety, machine.runtime
        if now == self._before:
            return
        self._before = now
        out["robot_mode"], out["safety_mode"] = int(modes.robot), int(modes.safety)
        out["safety_status_bits"] = SAFETY_BITS[modes.safety]
        out.offer("safety_status", int(modes.safety))
        out["runtime_state"] = int(machine.runtime)
        powered = modes.robot >= RobotMode.POWER_ON
        out["robot_status_bits"] = POWER_ON * powered + PROGRAM_RUNNING * playing
        fault = modes.safety in (SafetyMode.FAULT, SafetyMode.VIOLATION)
        joint = JOINT_FAULT if fault else JOINT_MODES.get(modes.robot, JOINT_POWER_OFF)
        out["joint_mode"] = [joint] * 6
        _publish_supply(out, powered=powered, running=modes.robot is RobotMode.RUNNING)

    def _publish_load(self, machine: Machine) -> None:
        out, payload = machine.outputs, machine.body.declared
        out.offer("tcp_offset", machine.tcp.tolist())
        if payload is self._payload:
            return
        self._payload = payload
        out.offer("payload", payload.mass)
        out.offer("payload_cog", payload.com)
        out.offer("payload_inertia", payload.inertia)


def _supply_current(machine: Machine) -> float:
    """Return the current of the 48 V supply [A]: electronics, motor heat and mechanical work."""
    if machine.modes.robot < RobotMode.POWER_ON:
        return 0.0
    seen = machine.reading
    heat = WINDING_OHM * float(seen.current @ seen.current)
    work = float(seen.moment_target @ machine.setpoint[1])
    return STANDBY_A + (heat + max(0.0, work)) / SUPPLY_V


def _momentum(machine: Machine) -> float:
    """Return a rough momentum [kg·m/s]: half the arm and the whole payload at the TCP speed."""
    body = machine.body
    x, y, z, *_ = machine.outputs["actual_TCP_speed"]
    moved = 0.5 * float(body.arm.mass.sum()) + body.declared.mass
    return moved * math.sqrt(x * x + y * y + z * z)


def _publish_supply(out: Values, *, powered: bool, running: bool) -> None:
    """Update the outputs that depend only on the robot mode."""
    out["actual_main_voltage"] = SUPPLY_V
    out["actual_robot_voltage"] = SUPPLY_V if powered else 0.0
    out["actual_joint_voltage"] = [SUPPLY_V if powered else 0.0] * 6
    out["actual_execution_time"] = EXECUTION_MS
    out["tool_mode"] = TOOL_RUNNING if running else TOOL_IDLE
    out.offer("actual_current_window", [CURRENT_WINDOW_A] * 6)


DAMPING = 0.05
"""Damping of the least-squares solution for the wrench, which keeps the wrench finite in a
singularity."""


class Cartesian:
    """Computation of the RTDE outputs that need the kinematics of the arm."""

    def __init__(self, machine: Machine) -> None:
        body = machine.body
        self._lengths = lengths_of(body.arm)
        self._gains = body.arm.drive_gains
        self._gravity: Triple = body.gravity
        self._rate = 1.0 / machine.tick_s
        self._damping = DAMPING**2 * np.eye(6)
        self._setpoint: Setpoint = np.empty((3, 6))
        self._tcp: FloatArray = np.empty(6)
        self._before: list[float] | None = None

    def publish(self, machine: Machine) -> None:
        """Update the Cartesian outputs after a tick."""
        out, seen = machine.outputs, machine.reading
        tool = frame_of(machine.tcp)
        if machine.setpoint is not self._setpoint or machine.tcp is not self._tcp:
            self._setpoint, self._tcp = machine.setpoint, machine.tcp
            self._publish_target(out, tool)
        posture = Posture(self._lengths, seen.q)
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        speeds = seen.qd.tolist()
        out["actual_TCP_pose"] = pose_from(frame)
        out["actual_TCP_speed"] = twist_of(J, speeds)
        if "elbow_position" in out:
            out["elbow_position"] = posture.elbow
            out["elbow_velocity"] = posture.elbow_velocity(speeds)
        wrench = self._wrench(machine, J)
        out["actual_TCP_force"] = wrench
        out["tcp_force_scalar"] = math.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
        out["actual_tool_accelerometer"] = felt = self._felt(posture, out["target_TCP_speed"])
        if "ft_raw_wrench" in out:
            out["ft_raw_wrench"] = raw_wrench(machine, posture, felt)

    def _publish_target(self, out: Values, tool: Frame) -> None:
        """Update the outputs of the set-point, which is mostly at rest in a dwell program."""
        posture = Posture(self._lengths, self._setpoint[0])
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        out["target_TCP_pose"] = pose_from(frame)
        out["target_TCP_speed"] = twist_of(J, self._setpoint[1])

    def _wrench(self, machine: Machine, jacobian: list[float]) -> list[float]:
        """Return the wrench at the tool from the torque that the servo's model does not explain."""
        if machine.body.braked:
            return [0.0] * 6
        seen = machine.reading
        torque = (seen.current_target - seen.current) * self._gains
        J = np.array(jacobian).reshape(6, 6)
        _, wrench, _ = dposv(J @ J.T + self._damping, J @ torque)
        numbers: list[float] = wrench.tolist()
        return numbers

    def _felt(self, posture: Posture, twist: list[float]) -> Triple:
        """Return the set-point acceleration minus gravity, in the axes of the flange [m/s²]."""
        before = self._before or twist
        self._before = twist
        gx, gy, gz = self._gravity
        x, y, z = (self._rate * (twist[i] - before[i]) for i in range(3))
        return turned(inverted(posture.flange), x - gx, y - gy, z - gz)


def raw_wrench(machine: Machine, posture: Posture, felt: Triple) -> list[float]:
    """Return force [N] and torque [N·m] on the flange (6,), in its axes and about its origin.

    The wrench is the weight and inertia of the mounted payload, modelled as a point mass without
    rotation, plus the external pushes of the side channel. The sensor is ideal: no noise, no
    offset, and the declared payload is not subtracted.

    Args:
        machine: Machine with the arm.
        posture: Posture of the arm.
        felt: Acceleration minus gravity, in the axes of the flange [m/s²].
    """
    load = machine.body.mounted
    fx, fy, fz = (-load.mass * each for each in felt)
    x, y, z = load.com
    wrench = [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]
    push = machine.body.pushed
    if not push.any():
        return wrench
    flange = posture.flange
    J = np.array(posture.jacobian((flange[9], flange[10], flange[11]))).reshape(6, 6)
    pushed = np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), J @ push).tolist()
    back = inverted(flange)
    along = (*turned(back, *pushed[:3]), *turned(back, *pushed[3:]))
    return [a + b for a, b in zip(wrench, along, strict=True)]
