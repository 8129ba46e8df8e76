"""The controller itself: one tick after the other, without sockets and without wall time.

`Machine` has the arm, the modes, the program that plays and the motion that moves the arm; whatever
clients see is in its outputs. `HeatGuard` stops an arm that is too hot. Its limits and codes:
Universal Robots, error codes C62A1 (joint temperature high) and C62A11 (joint temperature, shut
down); the real arm switches the joint off then, here that is a protective stop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.ur.body import Body, Reading
from hil_mock_robot.ur.contracts import NOWHERE, Motion, Place, Program, Setpoint
from hil_mock_robot.ur.modes import Modes, RobotMode, RuntimeState
from hil_mock_robot.ur.motion import StopJoints
from hil_mock_robot.ur.motion_limits import MotionImpossible, joint_leaving_range, out_of_range
from hil_mock_robot.ur.rtde_variables import (
    Cartesian,
    Publishing,
    Series,
    Values,
    inputs_of,
    outputs_of,
)
from hil_mock_robot.ur.rtde_wire import Line

PROTECTIVE_STOP_RAD_S2 = 8.0
EMERGENCY_STOP_RAD_S2 = 16.0
PROGRAM_STOP_RAD_S2 = 8.0


@dataclass(frozen=True, slots=True)
class Event:
    """Something the primary interface and the journal tell.

    Attributes:
        kind: `program_started`, `program_stopped`, `protective_stop`, `emergency_stop`, `popup`,
            `error`, `text`, `refused`, …
        name: Of the program, or what else it is about.
        text: In words.
        code: UR's error code C…, 0 for none.
        place: Where in the text of a program it happened.
    """

    kind: str
    name: str = ""
    text: str = ""
    code: int = 0
    place: Place = NOWHERE


@dataclass(slots=True)
class Watchdog:
    """URScript `rtde_set_watchdog`: what happens when an input is not written often enough."""

    variable: str
    ticks: int
    action: str


class Machine:
    """One controller and its arm; nothing here is safe against a second thread.

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
        listeners: Told every `Event`.
        publishers: Called after every tick to fill outputs that need more than the joints.
        mishaps: Who hears of mistakes in programs and motions.
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
        self.publishers: list[Callable[[Machine], None]] = [Cartesian(self).publish]
        if powered:
            body.release()
        self.setpoint: Setpoint = body.setpoint
        self._heat, self._publishing = HeatGuard(), Publishing()
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
            self.protective_stop(self.reading.fault, held=False)
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
        """Replace what moves the arm; None lets the set-point stand still where it is."""
        self.motion = motion

    def play(self, program: Program) -> bool:
        """Stop what plays and play this; False when nothing may play now."""
        self.halt()
        if not self.modes.running:
            self.tell("refused", program.name, "the arm is not running")
            return False
        self.program, self.runtime = program, RuntimeState.PLAYING
        self.tell("program_started", program.name)
        program.begin(self)
        return True

    def halt(self) -> None:
        """End the program, whatever it does; what still moves comes to rest."""
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

    def protective_stop(self, code: int, *, held: bool = True, text: str = "") -> None:
        """Stop because something is wrong.

        Args:
            code: A code of `plant.records.FAULTS`, or UR's own.
            held: The servo still does what it is told; else the mechanical brakes do it.
            text: In words, where the code does not say it.
        """
        first = self.modes.running
        self.modes.protective_stop(code)
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, held=held)
        if first:
            self.tell("protective_stop", text=text, code=code)

    def emergency_stop(self) -> None:
        """The red button."""
        self.modes.emergency_stop()
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, held=True)
        self.tell("emergency_stop")

    def safeguard_stop(self) -> None:
        """A light curtain is broken: everything pauses, and the servo holds the arm."""
        if not self.modes.cause("safeguard stop"):
            return
        self.pause()
        self._come_to_rest(PROTECTIVE_STOP_RAD_S2, held=True)
        self.tell("safeguard_stop")

    def fault(self, code: int = 0) -> None:
        """The safety system fails: the arm stops, then its power is cut."""
        self.modes.fault(code)
        self.halt()
        self._come_to_rest(EMERGENCY_STOP_RAD_S2, held=True)
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
        # What these remember having told or seen was told and seen before.
        self._heat, self._publishing = HeatGuard(), Publishing()
        self.publishers[0] = Cartesian(self).publish
        self._publishing.publish(self)
        self.tell("booted")

    def fail(self, text: str, code: int = 0, place: Place = NOWHERE) -> None:
        """A runtime error of the program: it ends, and says why."""
        self.tell("error", self.program.name if self.program else "", text, code, place)
        self.halt()

    def tell(
        self, kind: str, name: str = "", text: str = "", code: int = 0, place: Place = NOWHERE
    ) -> None:
        """Let everybody who listens know."""
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

    def _come_to_rest(self, deceleration: float, *, held: bool) -> None:
        if not held:
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
