"""The thread that owns the robot program: leads the arm, kicks the watchdog, stops it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator

import numpy as np

from hil.core import CommandRefused, HilError, RobotConnectionError, RobotFault, RobotTimeout
from hil.robot import Segment
from hil_drivers.ur.control import Control
from hil_drivers.ur.course import Course
from hil_drivers.ur.hands import Hands
from hil_drivers.ur.lookout import LOOK_S, Lookout, Ticks
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import Phase

OBEY_WITHIN_S = 0.05
"""How soon the controller must be seen to obey a stop; whoever asked has other ways [s]."""


class Mover(threading.Thread):
    """Moves one arm by one robot program.

    Args:
        control: The program.
        ticks: Rows of the controller's state, none left out.
        options: Of the arm.
        frequency_hz: Of rows and set-points.
        leave: Ends this process when the connection or the program is gone.

    Attributes:
        course: What the arm is doing.
        alone: Nobody is there any more who could stop the arm if this thread does not.
    """

    def __init__(
        self,
        control: Control,
        ticks: Ticks,
        options: Options,
        frequency_hz: float,
        leave: Callable[[int], object] = os._exit,
    ) -> None:
        super().__init__(name="hil-ur-mover", daemon=True)
        self._control = control
        self._using = threading.Lock()
        self.course = Course(ticks.take(1.0)[-1], options)
        self._hands = Hands(control, self.course, options, frequency_hz)
        self._lookout = Lookout(ticks, self.course, options, leave, lambda: control.connected)
        self.alone = False

    def run(self) -> None:
        """Answer every row until the end."""
        self._lookout.start()
        news = self.course.news
        while not self._lookout.ending.is_set():
            if news.wait(LOOK_S):
                news.clear()
                self._tick(self.course.newest)

    def start_move(self, segment: Segment) -> None:
        """Let the controller move to a segment's end, by its own plan.

        Raises:
            CommandRefused: It has not accepted that.
        """
        with self._starting():
            self._hands.move(segment)

    def start_led(self, segment: Segment) -> None:
        """Lead the arm along a segment's set-points, beginning with the next tick.

        Raises:
            CommandRefused: The arm is not where the segment begins.
        """
        with self._starting():
            self._hands.lead(segment)

    def use(self, what: Callable[[Control], object]) -> None:
        """Do something with the program while the arm stands.

        Raises:
            CommandRefused: It moves.
        """
        if self.course.phase is not Phase.IDLE:
            raise CommandRefused("the arm is moving", hint="wait until the motion is over")
        with self._using:
            what(self._control)

    def stop(self) -> None:
        """Bring the arm to rest; from any thread.

        Raises:
            RobotTimeout: The arm was not seen to obey in time; tell the controller directly.
        """
        course = self.course
        course.asked.set()
        course.news.set()
        if course.phase is Phase.IDLE or course.obeyed.wait(OBEY_WITHIN_S):
            return
        if self.alone:
            self._lookout.go(
                RobotFault(
                    "nobody is there, and the program does not stop the arm",
                    hint="press the emergency stop if the arm moves, then connect again",
                )
            )
            return
        raise RobotTimeout("the program does not stop the arm in time", hint="stop it directly")

    def end(self) -> None:
        """Bring both threads to their end."""
        self._lookout.ending.set()
        for thread in (self, self._lookout):
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(1.0)

    @contextlib.contextmanager
    def _starting(self) -> Iterator[None]:
        course = self.course
        if not course.turn(Phase.STARTING, out_of=(Phase.IDLE,)):
            raise CommandRefused("a segment is still running", hint="read until it is over")
        try:
            # After the phase was set: a stop that comes now either is seen here, or sees that.
            if course.asked.is_set():
                raise CommandRefused("stopped before it was started", hint="prepare it again")
            with self._using:
                course.begun = float(course.newest["timestamp"])
                yield
        except BaseException as error:
            if isinstance(error, RobotConnectionError):
                self._lookout.go(error)
            course.rest()
            raise

    def _tick(self, row: np.void) -> None:
        if not self._using.acquire(blocking=False):
            return  # whoever has it is just commanding something, which is as good as a kick
        try:
            self._hands.act(row)
        except HilError as error:
            self._fail(error)
        except Exception as error:
            self._fail(RobotFault(f"{type(error).__name__}: {error}", hint="connect again"))
        finally:
            self._using.release()

    def _fail(self, error: HilError) -> None:
        """End a motion that does not go as it should; where the library does not, the session."""
        course = self.course
        if not isinstance(error, RobotFault):
            self._lookout.go(error)
            return
        course.fail(error)
        try:
            self._hands.brake(course.newest)
        except HilError as worse:
            self._lookout.go(worse)
