"""The process that moves a UR arm by `ur-rtde`: `MotionProcess` from outside, `UrMotion` inside.

`hil.robot` hosts `UrMotion` as it hosts a driver in a process of its own: its members are called
one after the other, but for `stop`. When the process on the other side dies, it is told so, stops
the arm, waits until it is at rest, and closes. From outside every request has a time limit, and the
process can be killed without harm to recordings, which do not pass through it.
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
"""How long the process may take to come up, to upload the program, to take over a motion or a
load, to say how it stands, to let the arm go [s]."""

STOP_S = 0.06
"""How long it may take to say that the stop is on its way; there is another way after that [s]."""


class MotionProcess:
    """Where `ur-rtde` lives. Calls are for one thread at a time, `stop` for any number.

    Args:
        name, model: Of the arm.
        options: As the station has them, and in tests what to put in place of `ur-rtde`.
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
        """Whether calls make sense."""
        return self._process is not None and self._process.answers

    @property
    def pid(self) -> int:
        """Of the process; 0 when there is none."""
        return self._process.pid if self._process is not None else 0

    @property
    def left(self) -> bool:
        """Whether it has stopped the arm and ended by itself: a row may come that explains it."""
        process = self._process
        return process is not None and process.exit_code in (LOST_EXIT, STALE_EXIT)

    def connect(self) -> None:
        """Start the process, let it upload the program and arm the watchdog.

        Raises:
            RobotConnectionError: It cannot reach the controller, hangs, or has died.
            CommandRefused, PluginError: What `UrMotion` raised.
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
        """Declare a load."""
        self._alive().ask("set_payload", COMMAND_S, asdict(payload))

    def prepare(self, segment: Segment) -> None:
        """Hand over the next segment."""
        self._alive().ask("prepare", COMMAND_S, *segment_document(segment))

    def start(self) -> float:
        """Begin it; returns the device time after which samples belong to it [s]."""
        self._alive().ask("start", COMMAND_S)
        return float(self.look()[0]["begun"])

    def look(self) -> StructArray:
        """One row of `hil_drivers.ur.motion.PROGRESS`.

        Raises:
            HilError: The error that ended the newest motion, once.
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
        """Stop the arm; takes no lock.

        Raises:
            HilError: It is not sure that the process has done that in time.
        """
        process = self._process
        if process is None:
            raise self._gone()
        process.stop(STOP_S)

    def close(self) -> None:
        """Let the process end the program and exit; takes seconds at most."""
        process, self._process = self._process, None
        if process is None:
            return
        try:
            if process.answers:
                process.ask("close", CLOSE_S)
        except HilError:
            return  # what follows ends it in any case, and its end stops the arm
        finally:
            process.end()

    def _alive(self) -> DriverProcess:
        if self._process is None:
            raise self._gone()
        return self._process

    def _gone(self) -> RobotConnectionError:
        return RobotConnectionError(
            f"{self._name}: nobody moves the arm any more", hint="connect again"
        )


RECEIVER = "hil_drivers.ur.rtde:Receiver"
REST_S = 3.0

PROGRESS = np.dtype(
    [("device_time", "<f8"), ("begun", "<f8"), ("qd", "<f8", (6,)), ("status", "<i4")]
)
"""One row per `read`: the controller's time now, when the newest motion began, how it stands."""


class UrMotion:
    """As much of a robot as this process needs.

    Args:
        name, model: Of the arm.
        library: Module that offers `RTDEControlInterface`; another one in tests.
        receiver: `module:Class` that offers the controller's rows.
        options: As the station has them.
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
        """The controller's software, as its RTDE server reports it."""
        version = ".".join(map(str, self._receiver.version))
        return Identity(self._model, "", version, "ur")

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`."""
        return limits_of(self._model, self._options)

    def connect(self) -> None:
        """Upload the robot program, and arm its watchdog.

        Raises:
            RobotConnectionError: There is no controller, or another client owns the inputs.
            CommandRefused: The watchdog could not be armed.
            RobotFault: The program does not play.
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
        """Declare a load; the caller reads it back."""
        self._moving().use(lambda control: control.set_payload(payload))
        return payload

    def prepare(self, segment: Segment) -> None:
        """Keep the next segment, and be done with stops that came before."""
        self._moving().state.clear()
        self._prepared = segment

    def start(self) -> None:
        """Begin the prepared segment: `move` by the controller's own plan, else led along."""
        segment, self._prepared = self._prepared, None
        if segment is None:
            raise nothing_prepared()
        thread = self._moving()
        if segment.kind == "move" and self._options.moves == "movej":
            thread.start_move(segment)
        else:
            thread.start_led(segment)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """One row of `PROGRESS`.

        Raises:
            HilError: The error that ended the newest motion, once.
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
        """See `hil.robot.Robot`; raises `RobotTimeout` if it has to be done another way."""
        if self._thread is not None:
            self._thread.stop()

    def client_gone(self) -> None:
        """The process that drove the arm has died: only this one can stop it."""
        self._alone = True
        if self._thread is not None:
            self._thread.alone = True

    def close(self) -> None:
        """Bring the arm to rest, end the program, release the inputs."""
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
        """Also one that a protective stop has paused: it would go on once that is unlocked."""
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
    """Drop rows from before the program was uploaded.

    `ur-rtde` holds the interpreter meanwhile, and comes back when its own connection says that the
    program plays: what came over ours may still wait to be heard.

    Args:
        receiver: Of the controller's rows.

    Raises:
        RobotTimeout: No row came.
        RobotFault: The program does not play.
    """
    until = time.monotonic() + PLAYS_WITHIN_S
    while int(receiver.take(1.0)[-1]["runtime_state"]) != PLAYING:
        if time.monotonic() > until:
            raise RobotFault(
                "the robot program does not play after it was uploaded",
                hint="look for a message at the teach pendant, then connect again",
            )


def _runtime_state(receiver: Any) -> int:
    """Return RTDE's `runtime_state` by now; that of a program that plays if none comes."""
    with contextlib.suppress(HilError):
        with contextlib.suppress(RobotTimeout):
            receiver.take(0.0)
        return int(receiver.take(LAST_ROW_S)[-1]["runtime_state"])
    return PLAYING
