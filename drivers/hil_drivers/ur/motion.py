"""The process that moves the arm, seen from outside: every request has its time."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from hil.arms import Payload
from hil.core import HilError, RobotConnectionError, StaleState, StructArray
from hil.robot import DriverProcess, Segment, garbage, plain_options, segment_document
from hil_drivers.ur.lookout import LOST_EXIT, SILENCE_HINT, STALE_EXIT

CHILD = "hil_drivers.ur.motion_child:UrMotion"
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
        """One row of `hil_drivers.ur.motion_child.PROGRESS`.

        Raises:
            HilError: Why the newest motion was ended; told once.
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
        """Let the process end the program and come to its end itself; seconds at most."""
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
