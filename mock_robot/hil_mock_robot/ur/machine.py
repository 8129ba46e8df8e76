"""The controller itself: one tick after the other, without sockets and without wall time.

`Machine` has the arm, the modes, the `Program` that plays and the motion that moves the arm; the
state that clients see is in its outputs. After every tick `Publishing` fills in joints, modes and
supply, `Cartesian` the outputs that need kinematics: TCP, elbow, accelerometer, wrench. Quantities
that the plant does not have are simple but plausible (docs/reference/mock-ur-rtde.md,
docs/reference/mock-ur-motions.md).

`HeatGuard` stops an arm that is too hot. Its limits and codes: Universal Robots, error codes C62A1
(joint temperature high) and C62A11 (joint temperature, shut down); the real arm switches the joint
off then, here that is a protective stop.
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
    """A place in the text of a program.

    Attributes:
        line, column: From 1; column 1 if it is not known.
        token: Text of the program there, `""` for prose.
    """

    line: int = 1
    column: int = 1
    token: str = ""


NOWHERE = Place()


@dataclass(frozen=True, slots=True)
class Event:
    """An event for the primary interface and the journal.

    Attributes:
        kind: `program_started`, `program_stopped`, `protective_stop`, `emergency_stop`, `popup`,
            `error`, `text`, `refused`, …
        name: Of the program, or another subject.
        text: In words.
        code: UR's error code C…, 0 for none.
        place: In the text of a program.
    """

    kind: str
    name: str = ""
    text: str = ""
    code: int = 0
    place: Place = NOWHERE


@dataclass(slots=True)
class Watchdog:
    """URScript `rtde_set_watchdog`: the action if an input is not written within so many ticks."""

    variable: str
    ticks: int
    action: str


class Program(Protocol):
    """A robot program, called in each tick as long as it plays.

    Attributes:
        name: Of its `def`.
    """

    name: str

    def begin(self, machine: Machine) -> None:
        """Prepare to play."""

    def tick(self, machine: Machine) -> bool:
        """Do the work of one tick; return False once the program is over."""

    def end(self, machine: Machine) -> None:
        """Clean up, at the end or when stopped; the machine brakes a motion that is under way."""


class Machine:
    """One controller and its arm, for one thread.

    Args:
        series: Which generation of controller.
        body: The arm.
        serial: Its number: digits only.

    Attributes:
        inputs, outputs: RTDE's variables.
        modes: Power and safety.
        ticks: Since it was switched on.
        tcp: (6,) tool centre point in the flange frame, metres and rotation vector.
        program: What plays or is paused.
        runtime: State of the program.
        motion: What moves the arm, None when the set-point stands still.
        reading: What the joints reported last.
        written: Input → tick in which it was last written.
        watchdog: Set by the program that plays.
        speed_fraction: The speed slider, 0 to 1.
        listeners: Called with every `Event`.
        watches: Input → called with the value when a client writes it.
        mishaps: Mistakes of the mock in programs and motions.
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
        """The controller's clock: RTDE `timestamp` [s]."""
        return self.ticks * self.tick_s

    def tick(self) -> None:
        """Let one tick of device time pass."""
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
        """An input comes from a client."""
        self.inputs[name] = value
        self.outputs.offer(name, value)
        self.written[name] = self.ticks
        if name in self.watches:
            self.watches[name](value)

    def move(self, motion: Motion | None) -> None:
        """Replace the motion; None keeps the set-point where it is."""
        self.motion = motion

    def play(self, program: Program) -> bool:
        """Stop the program that plays and play this one; return False if none may play now."""
        self.halt()
        if not self.modes.running:
            self.tell("refused", program.name, "the arm is not running")
            return False
        self.program, self.runtime = program, RuntimeState.PLAYING
        self.tell("program_started", program.name)
        program.begin(self)
        return True

    def halt(self) -> None:
        """End the program; a motion that is under way comes to rest."""
        program, self.program = self.program, None
        self.runtime, self.watchdog = RuntimeState.STOPPED, None
        if program is not None:
            program.end(self)
            self.tell("program_stopped", program.name)
        if self.motion is not None and not isinstance(self.motion, StopJoints):
            self.motion = StopJoints(PROGRAM_STOP_RAD_S2, self.tick_s)

    def pause(self) -> None:
        """Hold the program where it is."""
        if self.runtime is RuntimeState.PLAYING:
            self.runtime = RuntimeState.PAUSED

    def resume(self) -> None:
        """Let a paused program go on."""
        if self.runtime is RuntimeState.PAUSED and self.modes.running:
            self.runtime = RuntimeState.PLAYING

    def protective_stop(self, code: int, *, by_servo: bool = True, text: str = "") -> None:
        """Stop because something is wrong.

        Args:
            code: A code of `plant.records.FAULTS`, or UR's own.
            by_servo: Whether the servo stops the arm; else the mechanical brakes do.
            text: In words, where the code does not say it.
        """
        first = self.modes.running
        self.modes.protective_stop(code)
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, by_servo=by_servo)
        if first:
            self.tell("protective_stop", text=text, code=code)

    def emergency_stop(self) -> None:
        """The red button."""
        self.modes.emergency_stop()
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, by_servo=True)
        self.tell("emergency_stop")

    def safeguard_stop(self) -> None:
        """A light curtain is broken: everything pauses, and the servo holds the arm."""
        if not self.modes.cause("safeguard stop"):
            return
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, by_servo=True)
        self.tell("safeguard_stop")

    def fault(self, code: int = 0) -> None:
        """The safety system fails: the arm stops, then its power is cut."""
        self.modes.fault(code)
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, by_servo=True)
        self.tell("fault", code=code)

    def cut_power(self) -> None:
        """The controller goes dark: the mechanical brakes stop the arm at once."""
        self.halt()
        self._lock()
        self.reading = self.body.step(self.setpoint)
        self.tell("power_cut")

    def boot(self, *, powered: bool) -> None:
        """Start anew after `cut_power`: the clock at 0, nothing declared, nothing loaded."""
        self.inputs, self.outputs = inputs_of(self.series), outputs_of(self.series)
        remote = self.modes.remote
        self.modes = Modes(self.tick_s, powered=powered)
        self.modes.remote = remote
        self.ticks, self.written, self.tcp = 0, {}, np.zeros(6)
        self.speed_fraction = 1.0
        self.body.forget()
        self.setpoint = self.body.setpoint
        # Without what they remember of the time before.
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
        """Pass an event to the listeners."""
        event = Event(kind, name, text, code, place)
        for listener in self.listeners:
            listener(event)

    def _play_on(self, program: Program) -> None:
        """A tick of the program; a mistake of ours in it ends it, and nothing else."""
        try:
            plays = program.tick(self)
        except Exception as error:
            self.fail(f"the program cannot go on: {self.mishaps.met(error, 'a program')}")
            return
        if not plays:
            self.halt()

    def _power(self) -> None:
        """The brakes follow the robot mode."""
        on = self.modes.robot is RobotMode.RUNNING
        if on and self.body.braked and self.modes.running:
            self.body.release()
            self.setpoint = self.body.setpoint
        elif not on and not self.body.braked:
            self.halt()
            self._lock()

    def _guard(self) -> None:
        """The watchdog a program has set."""
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
            why = f"the motion cannot go on: {self.mishaps.met(error, 'a motion')}"
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
        """A motion cannot begin or go on: a protective stop, or a runtime error of its program."""
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
"""So far below a limit it may be exceeded, and told, once more."""

CODE = 62


class HeatGuard:
    """Looks at the measured temperatures once a tick."""

    def __init__(self) -> None:
        self._high = False

    def look(self, machine: Machine) -> None:
        """Warn once, and stop as long as a joint is too hot."""
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
"""Heat in each motor and its amplifier per square of its current: a usual value."""

EXECUTION_MS = 0.35
"""`actual_execution_time` does not depend on the computer that simulates."""

DEVIATION_RAD = 0.1
"""Distance of actual from target position that `joint_position_deviation_ratio` counts as 1."""

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
    """Fills in the RTDE outputs of one machine; modes and load only when they change."""

    def __init__(self, machine: Machine) -> None:
        self._cartesian = Cartesian(machine)
        self._before: tuple[object, ...] = ()
        self._payload: object = None

    def publish(self, machine: Machine) -> None:
        """Fill in the outputs after a tick."""
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
    """Return the current of the 48 V supply [A]: electronics, heat in the motors, work."""
    if machine.modes.robot < RobotMode.POWER_ON:
        return 0.0
    seen = machine.reading
    heat = WINDING_OHM * float(seen.current @ seen.current)
    work = float(seen.moment_target @ machine.setpoint[1])
    return STANDBY_A + (heat + max(0.0, work)) / SUPPLY_V


def _momentum(machine: Machine) -> float:
    """Return half the arm and the whole load at the speed of the TCP [kg·m/s]: a rough value."""
    body = machine.body
    x, y, z, *_ = machine.outputs["actual_TCP_speed"]
    moved = 0.5 * float(body.arm.mass.sum()) + body.declared.mass
    return moved * math.sqrt(x * x + y * y + z * z)


def _publish_supply(out: Values, *, powered: bool, running: bool) -> None:
    """Fill in the outputs that change with the mode only."""
    out["actual_main_voltage"] = SUPPLY_V
    out["actual_robot_voltage"] = SUPPLY_V if powered else 0.0
    out["actual_joint_voltage"] = [SUPPLY_V if powered else 0.0] * 6
    out["actual_execution_time"] = EXECUTION_MS
    out["tool_mode"] = TOOL_RUNNING if running else TOOL_IDLE
    out.offer("actual_current_window", [CURRENT_WINDOW_A] * 6)


DAMPING = 0.05
"""Damping of the least squares: keeps the wrench finite in a singularity."""


class Cartesian:
    """Computes those outputs of a machine that need its kinematics."""

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
        """Fill in the outputs after a tick."""
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
        """Fill in outputs of the set-point, which is mostly at rest in a dwell program."""
        posture = Posture(self._lengths, self._setpoint[0])
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        out["target_TCP_pose"] = pose_from(frame)
        out["target_TCP_speed"] = twist_of(J, self._setpoint[1])

    def _wrench(self, machine: Machine, jacobian: list[float]) -> list[float]:
        """Return the wrench at the tool, from the torque that the servo's model does not have."""
        if machine.body.braked:
            return [0.0] * 6
        seen = machine.reading
        torque = (seen.current_target - seen.current) * self._gains
        J = np.array(jacobian).reshape(6, 6)
        _, wrench, _ = dposv(J @ J.T + self._damping, J @ torque)
        numbers: list[float] = wrench.tolist()
        return numbers

    def _felt(self, posture: Posture, twist: list[float]) -> Triple:
        """Return acceleration of the set-point less gravity, in the flange's axes [m/s²]."""
        before = self._before or twist
        self._before = twist
        gx, gy, gz = self._gravity
        x, y, z = (self._rate * (twist[i] - before[i]) for i in range(3))
        return turned(inverted(posture.flange), x - gx, y - gy, z - gz)


def raw_wrench(machine: Machine, posture: Posture, felt: Triple) -> list[float]:
    """Return (6,) force [N] and torque [N·m] on the flange, in its axes, about its origin.

    It is weight and inertia of the load that really hangs there, as a point mass that does not
    turn, and the pushes of the side channel. The sensor is ideal: no noise, no offset, and the
    declared load is not subtracted.

    Args:
        machine: With the arm.
        posture: Of the arm.
        felt: Acceleration less gravity, in the axes of the flange [m/s²].
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
