"""The thread that sees every row of the controller, whatever `ur-rtde` is waiting for."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from hil.core import (
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
    StructArray,
)
from hil_drivers.ur.course import Course
from hil_drivers.ur.direct_stop import stop_directly, stop_program
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import Phase
from hil_drivers.ur.rows import PLAYING, STOPPED

LOOK_S = 0.02
SILENT_S = 1.5
"""Without a word for so long the session is over. After 2.5 s `ur-rtde` would connect again by
itself, and upload its program, whatever the arm was doing [s]."""

FRESH_S = 0.1
"""A state younger than this is taken for the present one where the arm is to be stopped [s]."""

DOZE_S = 0.05
"""A look that takes longer was held up by this computer: nothing is known of the controller [s]."""

LOST_EXIT, STALE_EXIT = 3, 4
"""Exit codes of a process that has lost its controller, or its program there; and of one that has
stopped the arm because nothing was heard of the controller."""

SILENCE_HINT = "check the network between this computer and the controller, then connect again"


class Ticks(Protocol):
    """Where the controller's samples come from: RTDE rows with the names of RTDE's variables."""

    @property
    def age_s(self) -> float:
        """How long ago the controller's clock was last heard to go on [s]."""

    def take(self, timeout_s: float) -> StructArray:
        """All rows since the last call, at least one; raises `RobotTimeout`."""


class Lookout(threading.Thread):
    """Judges silence, the end of the program, and whether a stop is obeyed.

    `ur-rtde` connects again by itself as soon as its own connection ends: it stops the program,
    uploads it once more without a watchdog, and repeats the command it was about to give. From
    here that looks like a program that ends, a command that fails, or like nothing at all but a
    connection that is another one. Whatever it is, this process goes before anything more can be
    commanded; whoever wants to go on connects again.

    Args:
        ticks: Rows of the controller's state, none left out.
        course: What the arm is doing.
        options: Of the arm.
        leave: Ends this process.
        connected: Whether `ur-rtde` has its first connection still.
    """

    def __init__(
        self,
        ticks: Ticks,
        course: Course,
        options: Options,
        leave: Callable[[int], object],
        connected: Callable[[], bool] = lambda: True,
    ) -> None:
        super().__init__(name="hil-ur-lookout", daemon=True)
        self._connected = connected
        self._ticks, self._course, self._options = ticks, course, options
        self._leave = leave
        self._going = threading.Lock()
        self._looked, self._dozed = time.monotonic(), False
        self.ending = threading.Event()

    def run(self) -> None:
        """Look at every row until the end."""
        while not self.ending.is_set():
            self._looked = time.monotonic()
            try:
                rows = self._ticks.take(LOOK_S)
            except RobotTimeout:
                self._silent()
            except HilError as error:
                self._lost(error.message)
            except Exception as error:
                self._lost(f"{type(error).__name__}: {error}")
            else:
                self._see(rows)

    def _see(self, rows: StructArray) -> None:
        course = self._course
        if not self._connected():
            return self._cut_off()
        # A repeated state is no news: a controller that hangs is silent, and gets no set-point that
        # might come in after the stop.
        news = rows[-1]["timestamp"] != course.newest["timestamp"]
        course.newest, course.heard = rows[-1], time.monotonic() - self._ticks.age_s
        ended = rows["runtime_state"] != PLAYING
        if ended.any():
            return self._program_ended(rows[ended][0])
        if course.phase is Phase.BRAKING:
            self._watch_ramp(rows)
        if news:
            course.news.set()
        if self._ticks.age_s > self._options.late_s:
            self._silent()
        else:
            self._dozed = False

    def _watch_ramp(self, rows: StructArray) -> None:
        ramp, newest = self._course.ramp, rows[-1]
        if ramp is None:
            return
        if any(ramp.falls(row) for row in rows):
            self._course.obeyed.set()
        if ramp.stands(newest):
            self._course.rest()
        elif ramp.overdue(newest):
            self.go(
                RobotFault(
                    "the arm has not come to rest in the time of its stop: it was stopped directly",
                    hint="see to the robot itself, then connect again",
                )
            )

    def _silent(self) -> None:
        """Nothing comes: `ur-rtde` would wait for an answer, for minutes if need be."""
        if self._dozes():
            return
        course = self._course
        for_s = time.monotonic() - course.heard
        if not self._connected():
            return self._cut_off()
        if self._ticks.age_s > SILENT_S:
            return self._lost(f"the controller has not said anything for {for_s:.1f} s")
        allowed_s = FRESH_S if course.asked.is_set() else self._options.late_s
        if course.under_way and for_s > allowed_s:
            self.go(
                StaleState(
                    f"the controller has not said anything for {for_s:.2f} s while the arm was "
                    "moving",
                    hint=SILENCE_HINT,
                )
            )

    def _dozes(self) -> bool:
        """Whether what has come may still wait to be heard: not believed twice in a row."""
        late = time.monotonic() - self._looked > DOZE_S
        self._dozed = late and not self._dozed
        return self._dozed

    def _program_ended(self, row: np.void) -> None:
        """A program that is only paused would go on with its old move once it is let."""
        at = f"at device time {float(row['timestamp']):.3f} s"
        self.go(
            RobotFault(
                f"the robot program ended {at}",
                hint="look for a stop or a message at the teach pendant, connect again; `hil "
                "resume` goes on at the last checkpoint",
            ),
            paused=int(row["runtime_state"]) != STOPPED,
        )

    def _cut_off(self) -> None:
        """The program is not led any more; one that was uploaded anew has no watchdog."""
        self.go(
            RobotConnectionError(
                "connection lost: ur-rtde's own has ended",
                hint="check the network, then connect again",
            ),
            paused=True,
        )

    def _lost(self, why: str) -> None:
        self.go(
            RobotConnectionError(
                f"connection lost: {why}", hint="check the network, then connect again"
            )
        )

    def go(self, error: HilError, *, paused: bool = False) -> None:
        """Stop the arm without `ur-rtde`, and leave before that does anything more; once.

        Args:
            error: Why; the last word of this process.
            paused: Whether the program may go on without us, and must be ended.
        """
        with self._going:
            if self.ending.is_set():
                return
            self.ending.set()
        options, told = self._options, False
        if self._course.phase is not Phase.IDLE:
            told = stop_directly(options.address, options.stop_rad_s2)
        if paused:
            told = stop_program(options.address) or told
        if told:
            self._course.obeyed.set()
        self._course.fail(error)
        print(error.message, file=sys.stderr, flush=True)  # noqa: T201
        self._leave(STALE_EXIT if isinstance(error, StaleState) else LOST_EXIT)
