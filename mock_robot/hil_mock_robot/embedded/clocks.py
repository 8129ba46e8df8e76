"""Clocks: what advances the simulation.

`VirtualClock` advances when the robot is read, `WallClock` by a thread of its own, read or not.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hil.core import RobotFault, RobotTimeout, StructArray
from hil_mock_robot.embedded.controller import Controller
from hil_mock_robot.embedded.options import Options, wall_block_of
from hil_mock_robot.plant.records import WATCHDOG


class Clock(Protocol):
    """How time passes for one robot; `catch_up`, `contact` and `forget` need the lock."""

    def begin(self) -> None:
        """The robot was connected."""

    def end(self) -> None:
        """The robot is closed; returns when its arm rests, as far as time passes for it."""

    def catch_up(self) -> None:
        """Let all samples pass that were due before now."""

    def contact(self) -> None:
        """The host has shown itself."""

    def read(self, timeout_s: float) -> StructArray:
        """See `hil.robot.Robot.read`."""

    def forget(self) -> None:
        """Drop rows that were not read."""


class VirtualClock:
    """Advances only when it is read.

    Args:
        controller: Advanced by this clock.
        changed: Its lock; notified when the robot is closed.
        block: Samples at once.
    """

    def __init__(self, controller: Controller, changed: threading.Condition, block: int) -> None:
        self._controller, self._changed, self._block = controller, changed, block

    def begin(self) -> None:
        """See `Clock.begin`."""

    def end(self) -> None:
        """See `Clock.end`: here time stands still."""

    def catch_up(self) -> None:
        """See `Clock.catch_up`: here nothing is ever due."""

    def contact(self) -> None:
        """See `Clock.contact`."""

    def forget(self) -> None:
        """See `Clock.forget`: here nothing waits."""

    def read(self, timeout_s: float) -> StructArray:
        """One block, or as many as it takes until a row gets through."""
        end = math.inf
        while True:
            # Taken anew for every block: stop() must not wait for a row that may never come.
            with self._changed:
                controller = self._controller
                self._require_row_ahead(controller)
                if end == math.inf:
                    end = controller.arm.device_time + timeout_s
                rows = controller.produce(self._block)
                if len(rows):
                    return controller.hand_over(rows)
                if controller.arm.dead:
                    raise controller.fault_error()
                if controller.arm.device_time >= end and not controller.line.hanging:
                    raise timed_out(controller.name, timeout_s)

    def _require_row_ahead(self, controller: Controller) -> None:
        controller.require_connection()
        while controller.line.hanging:
            self._changed.wait()
            controller.require_connection()
        if controller.fault_told or controller.arm.dead:
            controller.come_to_rest()
            raise controller.fault_error()


def timed_out(name: str, timeout_s: float) -> RobotTimeout:
    """The error of a read in vain."""
    return RobotTimeout(
        f"mock robot {name}: no state row within {timeout_s:g} s",
        hint="check the connection and whether the controller is still switched on",
    )


SLIP_S = 0.25
"""Further behind than this (the machine slept), time goes on from now and nothing is made up."""

REST_WITHIN_S = 5.0
"""Simulated time that `end` waits for the arm at most."""

JOIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Pace:
    """How a robot lives in wall time.

    Attributes:
        block: Samples computed at once.
        spacing_s: Wall time between samples.
        speed: Simulated seconds per second of wall time.
        rows: How many rows wait to be read; older ones are lost.
        watchdog_s: See `Options`.
    """

    block: int
    spacing_s: float
    speed: float
    rows: int
    watchdog_s: float


def pace_of(options: Options, rate_hz: float) -> Pace:
    """The pace that the options ask for.

    Raises:
        SpecError: Samples are so far apart that `stop` would act too late.
    """
    block = wall_block_of(options, rate_hz)
    spacing_s = 1.0 / (rate_hz * options.speed)
    rows = max(2 * block, round(options.queue_s / spacing_s))
    return Pace(block, spacing_s, options.speed, rows, options.watchdog_s)


class WallClock:
    """Advances by itself, by absolute deadlines of the monotonic clock.

    What is due is computed by whoever holds the lock first: the thread, a reader, or a command,
    which thus acts on the arm as it is now, however late the thread may be.

    Args:
        controller: Advanced by this clock.
        changed: Its lock; notified when there are rows or the robot is closed.
        pace: How fast, and what else.
    """

    def __init__(self, controller: Controller, changed: threading.Condition, pace: Pace) -> None:
        self._controller, self._changed, self._pace = controller, changed, pace
        self._queue: deque[StructArray] = deque()
        self._queued = self._lost = 0
        self._began = self._contact = 0.0
        self._passed = 0
        self._readers = 0
        self._advancing = False
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._broken: Exception | None = None

    @property
    def running(self) -> bool:
        """Whether time passes."""
        return self._thread is not None and self._thread.is_alive()

    def begin(self) -> None:
        """Start the thread, if it is not running."""
        if self.running:
            return
        self._ending.clear()
        self._broken = None
        self._began, self._passed = time.monotonic(), 0
        self.contact()
        name = f"mock robot {self._controller.name}"
        self._thread = threading.Thread(target=self._pass, name=name, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Wait until the arm rests, then end the thread."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._controller.still or not self.running,
                REST_WITHIN_S / min(self._pace.speed, 1.0),
            )
        self.abandon()
        self.forget()

    def abandon(self) -> None:
        """End the thread at once, as the death of the process would."""
        self._ending.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(JOIN_S)
        self._thread = None

    def contact(self) -> None:
        """See `Clock.contact`."""
        self._contact = time.monotonic()

    def forget(self) -> None:
        """See `Clock.forget`."""
        self._queue.clear()
        self._queued = self._lost = 0

    def read(self, timeout_s: float) -> StructArray:
        """Return rows since the last call; wait if there are none."""
        end = time.monotonic() + timeout_s
        with self._changed:
            self._readers += 1
            try:
                while True:
                    self._advance(self._pace.block)
                    if (rows := self._taken()) is not None:
                        return self._controller.hand_over(rows)
                    left = end - time.monotonic()
                    if left <= 0 and not self._controller.line.hanging:
                        raise timed_out(self._controller.name, timeout_s)
                    self._changed.wait(None if self._controller.line.hanging else left)
            finally:
                self._readers -= 1

    def _taken(self) -> StructArray | None:
        """All rows that wait, or None; raises when there is no use in waiting."""
        controller = self._controller
        controller.require_connection()
        if self._broken is not None:
            raise RobotFault(
                f"{controller.name}: the simulation failed: {self._broken!r}",
                hint="this is a bug in the mock robot",
            ) from self._broken
        if controller.line.hanging:
            return None
        if controller.fault_told or (controller.arm.dead and not self._queue):
            raise controller.fault_error()
        if not self._queue:
            return None
        rows = np.concatenate(self._queue) if len(self._queue) > 1 else self._queue[0]
        if self._lost:
            controller.note("overflow", rows=self._lost)
        self.forget()
        self.contact()
        return rows

    def catch_up(self) -> None:
        """See `Clock.catch_up`."""
        self._advance(1)

    def _pass(self) -> None:
        """The thread: wakes whenever a block is due."""
        block, spacing_s = self._pace.block, self._pace.spacing_s
        while self._broken is None:
            due = self._began + (self._passed + block) * spacing_s
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return
            with self._changed:
                self._advance(block)

    def _advance(self, least: int) -> None:
        """Let due samples pass, if they are at least so many."""
        # Advancing already: a signal handler has interrupted this thread in the middle of it.
        if self._advancing or self._thread is None or self._broken is not None:
            return
        due = self._due()
        if due < least:
            return
        self._advancing = True
        try:
            self._guard(self._controller)
            self._produce(due)
        except Exception as error:  # a mistake here must reach the reader
            self._broken = error
        finally:
            self._advancing = False
        self._passed += due
        self._changed.notify_all()

    def _due(self) -> int:
        spacing_s, block = self._pace.spacing_s, self._pace.block
        due = int((time.monotonic() - self._began) / spacing_s + 1e-9) - self._passed
        if due <= max(block, SLIP_S / spacing_s):
            return due
        self._began += (due - block) * spacing_s
        self._controller.note("slip", behind_s=round((due - block) * spacing_s, 6))
        return block

    def _produce(self, count: int) -> None:
        controller = self._controller
        while count > 0 and not controller.arm.dead:
            before = controller.samples
            rows = controller.produce(count)
            count -= controller.samples - before
            if len(rows):
                self._keep(rows)

    def _guard(self, controller: Controller) -> None:
        """The controller's watchdog."""
        if self._readers and not controller.line.silent:
            self.contact()
        allowed = self._pace.watchdog_s
        if not allowed or controller.rest.waiting or not controller.arm.moving:
            return
        if time.monotonic() - self._contact > allowed:
            controller.trip(WATCHDOG)

    def _keep(self, rows: StructArray) -> None:
        self._queue.append(rows)
        self._queued += len(rows)
        while self._queued > self._pace.rows:
            oldest, surplus = self._queue.popleft(), self._queued - self._pace.rows
            if len(oldest) > surplus:
                self._queue.appendleft(oldest[surplus:])
            lost = min(len(oldest), surplus)
            self._queued -= lost
            self._lost += lost
