"""Separate process that moves a UR arm by `ur-rtde`.

`MotionProcess` is the client side of the process, and `UrMotion` runs inside the process.
`hil.robot` runs `UrMotion` like a driver in a separate process. The members of `UrMotion` are
called one after the other, except `stop`, which can be called at any time. If the client process
dies, `UrMotion` is notified, stops the arm, waits until the arm is at rest, and closes. Every
request of the client to the motion process has a time limit. The motion process can be killed
without an effect on recordings, because the recorded rows do not pass through the motion process.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import (
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
    StructArray,
)
from hil.robot import (
    Capabilities,
    DriverProcess,
    Identity,
    Limits,
    Segment,
    Status,
    garbage,
    plain_options,
    segment_document,
)
from hil_drivers.arm import not_connected, nothing_prepared
from hil_drivers.ur.control import LIBRARY, Control
from hil_drivers.ur.dashboard import end_program, stop_directly
from hil_drivers.ur.options import capabilities_of, limits_of, options_of
from hil_drivers.ur.servo import LOST_EXIT, SILENCE_HINT, STALE_EXIT, MotionThread, Phase
from hil_drivers.ur.state import PLAYING, STOPPED

CHILD = "hil_drivers.ur.motion:UrMotion"

OPEN_S, CONNECT_S, COMMAND_S, LOOK_S, CLOSE_S = 30.0, 20.0, 8.0, 2.0, 6.0
"""Time limits of the motion process [s]: to start, to upload the program, to accept a motion or
a payload, to report its state, and to release the arm.
"""

STOP_S = 0.06
"""Time limit for the acknowledgement of a stop [s]; if the limit is exceeded, the driver stops
the arm directly."""


class MotionProcess:
    """Client of the process that runs `ur-rtde`.

    Only one thread at a time can call its methods; any thread can call `stop`.

    Args:
        name, model: Name and model of the arm.
        options: Mapping of options from the station file; tests also pass a replacement for
            `ur-rtde`.
    """

    def __init__(self, name: str, model: str, options: Mapping[str, Any]) -> None:
        self._name = name
        self._how = {
            "driver": CHILD,
            "name": name,
            "model": model,
            "options": plain_options(options),
            "gravity": None,
            "pythonpath": os.environ.get("PYTHONPATH"),
        }
        self._process: DriverProcess | None = None

    @property
    def alive(self) -> bool:
        """Whether the motion process runs and answers requests."""
        return self._process is not None and self._process.answers

    @property
    def pid(self) -> int:
        """Identifier of the motion process; 0 if there is no process."""
        return self._process.pid if self._process is not None else 0

    @property
    def left(self) -> bool:
        """Whether the motion process has stopped the arm and exited by itself.

        A row that arrives after the exit possibly shows why the motion process exited.
        """
        process = self._process
        return process is not None and process.exit_code in (LOST_EXIT, STALE_EXIT)

    def connect(self) -> None:
        """Start the motion process, which uploads the robot program and arms the watchdog.

        Raises:
            RobotConnectionError: The motion process cannot reach the controller, hangs, or has
                died.
            CommandRefused, PluginError: `UrMotion` raised an error of this class.
        """
        self.close()
        self._process = DriverProcess(f"{self._name}-motion")
        try:
            self._process.ask("open", OPEN_S, self._how)
            self._process.ask("connect", CONNECT_S)
        except BaseException:
            self._process.end()
            self._process = None
            raise

    def set_payload(self, payload: Payload) -> None:
        """Declare a payload."""
        self._alive().ask("set_payload", COMMAND_S, asdict(payload))

    def prepare(self, segment: Segment) -> None:
        """Send the next segment to the motion process."""
        self._alive().ask("prepare", COMMAND_S, *segment_document(segment))

    def start(self) -> float:
        """Start the prepared segment.

        Returns:
            Device time after which samples belong to the segment [s].
        """
        self._alive().ask("start", COMMAND_S)
        return float(self.look()[0]["begun"])

    def look(self) -> StructArray:
        """Return the state of the motion as one row of type `hil_drivers.ur.motion.PROGRESS`.

        Raises:
            HilError: An error ended the newest motion; each error is raised by one call only.
        """
        process = self._alive()
        try:
            _, arrays = process.ask("read", LOOK_S, {"timeout_s": LOOK_S})
        except RobotConnectionError as error:
            if process.exit_code != STALE_EXIT:
                raise
            said = process.printed.strip().splitlines() or [error.message]
            raise StaleState(said[-1], hint=SILENCE_HINT) from error
        if not arrays or not len(arrays[0]):
            raise garbage("progress without a row")
        return arrays[0]

    def stop(self) -> None:
        """Stop the arm; the call needs no lock.

        Raises:
            HilError: The motion process did not confirm the stop in time.
        """
        process = self._process
        if process is None:
            raise self._gone()
        process.stop(STOP_S)

    def close(self) -> None:
        """Let the motion process end the robot program and exit.

        The call of this method takes some seconds at most.
        """
        process, self._process = self._process, None
        if process is None:
            return
        try:
            if process.answers:
                process.ask("close", CLOSE_S)
        except HilError:
            return  # `end` below ends the process in any case, which stops the arm
        finally:
            process.end()

    def _alive(self) -> DriverProcess:
        if self._process is None:
            raise self._gone()
        return self._process

    def _gone(self) -> RobotConnectionError:
        return RobotConnectionError(
            f"{self._name}: the process that moves the arm has ended", hint="connect again"
        )


RECEIVER = "hil_drivers.ur.rtde:Receiver"
REST_S = 3.0

PROGRESS = np.dtype(
    [("device_time", "<f8"), ("begun", "<f8"), ("qd", "<f8", (6,)), ("status", "<i4")]
)
"""Row type of `UrMotion.read`: present device time, device time at which the newest motion
began, target joint speeds, and status.
"""


class UrMotion:
    """Robot driver inside the motion process, reduced to the members that this process needs.

    Args:
        name, model: Name and model of the arm.
        library: Name of the module with `RTDEControlInterface`; replaced in tests.
        receiver: Class of the receiver of the controller's rows, as `module:Class`.
        options: Options from the station file.
    """

    def __init__(
        self,
        name: str,
        model: str,
        *,
        library: str = LIBRARY,
        receiver: str = RECEIVER,
        **options: Any,
    ) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._library, self._receiver_kind = library, receiver
        self._receiver: Any = None
        self._control: Control | None = None
        self._thread: MotionThread | None = None
        self._prepared: Segment | None = None
        self._alone = False

    @property
    def identity(self) -> Identity:
        """Model of the arm and software version of the controller, as reported by RTDE."""
        version = ".".join(map(str, self._receiver.version))
        return Identity(self._model, "", version, "ur")

    @property
    def capabilities(self) -> Capabilities:
        """Names, rate and effort kind of the arm; see `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """Joint limits of the arm; see `hil.robot.Robot`."""
        return limits_of(self._model, self._options)

    def connect(self) -> None:
        """Upload the robot program and arm its watchdog.

        Raises:
            RobotConnectionError: No controller answers, or another client owns the RTDE inputs.
            CommandRefused: The watchdog could not be armed.
            RobotFault: The uploaded robot program does not play.
        """
        if self._thread is not None:
            return
        rate = self.capabilities.rate_hz
        module, _, kind = self._receiver_kind.partition(":")
        receiver = getattr(import_module(module), kind)(self._options.address, rate)
        receiver.open()
        try:
            series = tuple(receiver.version[:2])
            control = Control(self._options.address, rate, series, library=self._library)
            try:
                control.arm_watchdog(self._options.watchdog_hz)
                _wait_until_playing(receiver)
                thread = MotionThread(control, receiver, self._options, rate)
            except BaseException:
                self._end_program(control, receiver)
                raise
        except BaseException:
            receiver.close()
            raise
        self._receiver, self._control, self._thread = receiver, control, thread
        thread.alone = self._alone
        thread.start()

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a payload; the caller must check which payload the controller then reports."""
        self._moving().use(lambda control: control.set_payload(payload))
        return payload

    def prepare(self, segment: Segment) -> None:
        """Store the next segment and clear earlier stop requests."""
        self._moving().state.clear()
        self._prepared = segment

    def start(self) -> None:
        """Start the prepared segment: the controller plans a `move`; other kinds use `servoj`.

        If the option `moves` is `servoj`, a `move` segment is executed by `servoj` too.
        """
        segment, self._prepared = self._prepared, None
        if segment is None:
            raise nothing_prepared()
        thread = self._moving()
        if segment.kind == "move" and self._options.moves == "movej":
            thread.start_move(segment)
        else:
            thread.start_led(segment)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return one row of `PROGRESS`.

        Raises:
            HilError: An error ended the newest motion; each error is raised by one call only.
        """
        state = self._moving().state
        phase, row = state.phase, state.newest
        failure, state.failure = state.failure, None
        if failure is not None:
            raise failure
        status = Status.HOLDING if phase is Phase.IDLE else Status.MOVING
        progress = np.zeros(1, PROGRESS)
        progress[0] = (row["timestamp"], state.begun, row["target_qd"], int(status))
        return progress

    def stop(self) -> None:
        """Stop the arm; see `hil.robot.Robot`.

        Raises:
            RobotTimeout: The arm did not obey in time and must be stopped by a different method.
        """
        if self._thread is not None:
            self._thread.stop()

    def client_gone(self) -> None:
        """Record that the client process has died, so that only this process can stop the arm."""
        self._alone = True
        if self._thread is not None:
            self._thread.alone = True

    def close(self) -> None:
        """Stop the arm, end the program and release the RTDE inputs."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        try:
            self._come_to_rest(thread)
        finally:
            thread.end()
            try:
                if self._control is not None:
                    self._end_program(self._control, self._receiver)
            finally:
                self._receiver.close()

    def _end_program(self, control: Control, receiver: Any) -> None:
        """End the program, even if a protective stop has paused it.

        A paused program would resume as soon as the protective stop is unlocked.
        """
        try:
            control.end()
        finally:
            if _runtime_state(receiver) != STOPPED:
                end_program(self._options.address)

    def _come_to_rest(self, thread: MotionThread) -> None:
        try:
            thread.stop()
        except HilError:
            stop_directly(self._options.address, self._options.stop_rad_s2)
        until = time.monotonic() + REST_S
        while thread.state.phase is not Phase.IDLE and time.monotonic() < until:
            time.sleep(0.005)

    def _moving(self) -> MotionThread:
        if self._thread is None:
            raise not_connected(self._name)
        return self._thread


PLAYS_WITHIN_S = 5.0
LAST_ROW_S = 0.2


def _wait_until_playing(receiver: Any) -> None:
    """Drop rows until the uploaded program plays.

    `ur-rtde` blocks the interpreter during the upload and returns when its own connection reports
    that the program plays. After the upload, rows from before the start of the program are possibly
    still queued in the receiver.

    Args:
        receiver: Receiver of the controller's rows.

    Raises:
        RobotTimeout: No row of the controller arrived.
        RobotFault: The uploaded robot program does not play.
    """
    until = time.monotonic() + PLAYS_WITHIN_S
    while int(receiver.take(1.0)[-1]["runtime_state"]) != PLAYING:
        if time.monotonic() > until:
            raise RobotFault(
                "the robot program does not run after its upload",
                hint="look for a message at the teach pendant, then connect again",
            )


def _runtime_state(receiver: Any) -> int:
    """Return the present `runtime_state` of RTDE; `PLAYING` if no row arrives."""
    with contextlib.suppress(HilError):
        with contextlib.suppress(RobotTimeout):
            receiver.take(0.0)
        return int(receiver.take(LAST_ROW_S)[-1]["runtime_state"])
    return PLAYING
