"""Programs of several threads, advanced once a tick, of which one at a time moves the arm."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import TypeVar

from hil.core import CommandRefused
from hil_mock_robot.ur.contracts import Motion
from hil_mock_robot.ur.machine import PROGRAM_STOP_RAD_S2, Machine
from hil_mock_robot.ur.script_errors import place_of
from hil_mock_robot.ur.stopping import StopJoints

Steps = Generator[None, None, None]
"""A thread of a program: it yields where URScript waits for the next tick."""

M = TypeVar("M", bound=Motion)
MAIN = "main"
ANOTHER_THREAD = "Another thread is already controlling the robot"
IMPATIENT = "a secondary program takes no time: it cannot wait or move"
HAND_GUIDED = "The robot cannot move by itself while it is guided by hand"


class Threaded:
    """Implements `Program`; what it does is in the generator `main`.

    Args:
        name: What its `def` calls it.
        patient: Whether it may wait for ticks and move; a secondary program may not.

    Attributes:
        machine: Known from `begin` on.
        hand_guided: Whether people may push the arm around, which keeps it from moving itself.
    """

    machine: Machine

    def __init__(self, name: str, *, patient: bool = True) -> None:
        self.name, self.patient = name, patient
        self.hand_guided = False
        self._threads: dict[str, Steps] = {}
        self._turn = self._controlling = ""
        self._ticked = -1
        self._resumed = False

    def main(self) -> Steps:
        """The first thread; the program is over when it is."""
        raise NotImplementedError

    def begin(self, machine: Machine) -> None:
        """See `Program`."""
        self.machine = machine
        self.run(MAIN, self.main())

    def tick(self, machine: Machine) -> bool:
        """See `Program`; threads that are started in a tick have their first turn in it."""
        self._resumed = self._ticked >= 0 and machine.ticks - self._ticked > 1
        self._ticked = machine.ticks
        served: set[str] = set()
        try:
            while waiting := [name for name in self._threads if name not in served]:
                served.add(waiting[0])
                self._step(waiting[0])
        except CommandRefused as error:
            machine.fail(error.message, place=place_of(error))
        return MAIN in self._threads

    def end(self, machine: Machine) -> None:
        """See `Program`."""
        while self._threads:
            self._threads.popitem()[1].close()
        self._controlling = ""

    def run_at_once(self, machine: Machine) -> None:
        """Everything it does before it waits, without being what plays.

        Raises:
            CommandRefused: A runtime error.
        """
        self.begin(machine)
        try:
            self._step(MAIN)
        finally:
            self.end(machine)

    def run(self, name: str, steps: Steps) -> None:
        """Start a thread."""
        self._threads[name] = steps

    def runs(self, name: str) -> bool:
        """Whether there is such a thread."""
        return name in self._threads

    def kill(self, name: str) -> None:
        """End a thread, if it runs; what it moved comes to rest unless somebody moves it on."""
        thread = self._threads.pop(name, None)
        if thread is not None:
            moving = self._controlling == name
            thread.close()
            if moving:
                self.machine.move(self._stop())

    @contextmanager
    def control(self) -> Iterator[None]:
        """Be the thread that moves the arm.

        Raises:
            CommandRefused: Another thread is, the arm is guided by hand, or nothing may move it.
        """
        if not self.patient:
            raise CommandRefused(IMPATIENT)
        me = self._turn
        if self._controlling not in ("", me):
            raise CommandRefused(ANOTHER_THREAD)
        if self.hand_guided:
            raise CommandRefused(HAND_GUIDED)
        outermost, self._controlling = self._controlling != me, me
        try:
            yield
        finally:
            if outermost and self._controlling == me:
                self._controlling = ""

    def drive(
        self,
        make: Callable[[], M],
        *,
        watch: Callable[[M], None] = lambda _: None,
    ) -> Steps:
        """Move the arm until the motion is over.

        Args:
            make: The motion; called again after a pause, which had stopped it.
            watch: Called in every tick.
        """
        with self.control():
            again = True
            while again:
                motion = make()
                self.machine.move(motion)
                watch(motion)
                yield
                while self.machine.motion is motion:
                    watch(motion)
                    yield
                again = self._resumed

    def _stop(self) -> StopJoints:
        return StopJoints(PROGRAM_STOP_RAD_S2, self.machine.tick_s)

    def _step(self, name: str) -> None:
        self._turn = name
        try:
            next(self._threads[name])
        except StopIteration:
            self._threads.pop(name, None)
