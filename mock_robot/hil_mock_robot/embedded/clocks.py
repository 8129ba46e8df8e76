"""Clocks that advance the simulation.

`VirtualClock` advances when the robot is read, whereas `WallClock` advances by a separate thread.
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
    """Clock of one robot; the caller of `catch_up`, `contact` and `forget` must own the lock."""

    def begin(self) -> None:
        """Start the clock after the robot was connected."""

    def end(self) -> None:
        """Stop the clock of a closed robot; return when its arm is at rest, if possible."""

    def catch_up(self) -> None:
        """Compute all samples that have become due."""

    def contact(self) -> None:
        """Record that the host is active, for the watchdog."""

    def read(self, timeout_s: float) -> StructArray:
        """Return new rows; see `hil.robot.Robot.read`."""

    def forget(self) -> None:
        """Discard rows that were not read."""


class VirtualClock:
    """Clock that advances only when the robot is read.

    Args:
        controller: Controller that is advanced by this clock.
        changed: Lock of the controller; notified when the robot is closed.
        block: Maximum number of samples per block.
    """

    def __init__(self, controller: Controller, changed: threading.Condition, block: int) -> None:
        self._controller, self._changed, self._block = controller, changed, block

    def begin(self) -> None:
        """Do nothing; see `Clock.begin`."""

    def end(self) -> None:
        """Do nothing, because time does not pass here; see `Clock.end`."""

    def catch_up(self) -> None:
        """Do nothing, because no samples are ever due; see `Clock.catch_up`."""

    def contact(self) -> None:
        """Do nothing; see `Clock.contact`."""

    def forget(self) -> None:
        """Do nothing, because no rows are stored; see `Clock.forget`."""

    def read(self, timeout_s: float) -> StructArray:
        """Return the rows of one block, or of the first block with rows."""
        end = math.inf
        while True:
            # Locked per block, so that stop() need not wait for a row that may never arrive.
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
    """Return the error for a read that yields no rows."""
    return RobotTimeout(
        f"mock robot {name}: no state row within {timeout_s:g} s",
        hint="check the connection and whether the controller is still switched on",
    )


SLIP_S = 0.25
"""Delay [s] above which missed samples are skipped, for example after the computer was
suspended."""

REST_WITHIN_S = 5.0
"""Longest simulated time for which `end` waits for the arm [s]."""

JOIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Pace:
    """Timing of the wall clock of a robot.

    Attributes:
        block: Maximum number of samples per block.
        spacing_s: Wall time between samples [s].
        speed: Simulated seconds per second of wall time.
        rows: Largest number of rows that wait to be read; older rows are lost.
        watchdog_s: Wall time without a reader after which a moving arm is stopped [s]; see
            `Options`.
    """

    block: int
    spacing_s: float
    speed: float
    rows: int
    watchdog_s: float


def pace_of(options: Options, rate_hz: float) -> Pace:
    """Return the timing of the wall clock for the options.

    Raises:
        SpecError: The time between samples is so long that `stop` would act too late.
    """
    block = wall_block_of(options, rate_hz)
    spacing_s = 1.0 / (rate_hz * options.speed)
    rows = max(2 * block, round(options.queue_s / spacing_s))
    return Pace(block, spacing_s, options.speed, rows, options.watchdog_s)


class WallClock:
    """Clock that advances automatically, by absolute deadlines of the monotonic clock.

    Due samples are computed by the first owner of the lock: the thread, a reader, or a command. A
    command therefore acts on the current state of the arm, even if the thread is late.

    Args:
        controller: Controller that is advanced by this clock.
        changed: Lock of the controller; notified about new rows and when the robot is closed.
        pace: Timing of the clock.
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
        """Whether the thread of the clock is running."""
        return self._thread is not None and self._thread.is_alive()

    def begin(self) -> None:
        """Start the thread if it is not running."""
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
        """Wait until the arm is at rest, then end the thread."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._controller.still or not self.running,
                REST_WITHIN_S / min(self._pace.speed, 1.0),
            )
        self.abandon()
        self.forget()

    def abandon(self) -> None:
        """End the thread immediately, like after the death of the process."""
        self._ending.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(JOIN_S)
        self._thread = None

    def contact(self) -> None:
        """Record that the host is active, for the watchdog; see `Clock.contact`."""
        self._contact = time.monotonic()

    def forget(self) -> None:
        """Discard rows that were not read; see `Clock.forget`."""
        self._queue.clear()
        self._queued = self._lost = 0

    def read(self, timeout_s: float) -> StructArray:
        """Return the rows since the last call; wait if there are none."""
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
        """Return all waiting rows, or None; raise if no row can arrive any more."""
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
        """Compute all samples that have become due; see `Clock.catch_up`."""
        self._advance(1)

    def _pass(self) -> None:
        """Run the thread, which wakes when a block is due."""
        block, spacing_s = self._pace.block, self._pace.spacing_s
        while self._broken is None:
            due = self._began + (self._passed + block) * spacing_s
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return
            with self._changed:
                self._advance(block)

    def _advance(self, least: int) -> None:
        """Compute the due samples if their number is at least `least`."""
        # `_advancing` is set if a signal handler has interrupted this method.
        if self._advancing or self._thread is None or self._broken is not None:
            return
        due = self._due()
        if due < least:
            return
        self._advancing = True
        try:
            self._guard(self._controller)
            self._produce(due)
        except Exception as error:  # the reader must get this error
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
        """Run the watchdog of the controller."""
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
