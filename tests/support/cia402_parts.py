"""Drives for tests of the driver's core: the states of CiA 402 without a bus, a script or a plant.

Nothing of the driver's own state machine is in it: statuswords and transitions are the standard's.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from hil_drivers.cia402.bus import Inputs, News, Outputs
from hil_drivers.cia402.mapping import ALL_MODES, Mapping
from hil_drivers.cia402.supervisor import Phase, Supervisor

CSP, CST = 8, 10
PERIOD_S = 0.004

OFF, READY, ON, ENABLED, QUICK, FAULT = 0x0250, 0x0231, 0x0233, 0x1237, 0x0217, 0x0218
FOLLOWS = 0x1000


class FakeDrive:
    """One axis.

    Attributes:
        status: Statusword.
        stuck_at: A statusword that it does not leave by controlword.
        braking: Cycles that its quick stop takes.
        refuses_mode: It shows 0 whatever is asked.
        ignores: Bit 12 stays low.
        silent: It does not answer.
        written: Controlwords in the order in which they came, without repetitions.
    """

    def __init__(self, position: int) -> None:
        self.status, self.mode, self.position, self.torque = OFF, 0, position, 0
        self.stuck_at = self.last = 0
        self.braking, self.left = 3, 0
        self.refuses_mode = self.ignores = self.silent = False
        self.written: list[int] = []

    def apply(self, word: int, mode: int) -> None:
        """What a SYNC does to it."""
        if not self.written or self.written[-1] != word:
            self.written.append(word)
        self.mode = 0 if self.refuses_mode else mode
        before, self.last = self.last, word
        if self.status == QUICK:
            self.left -= 1
            self.status = OFF if self.left <= 0 or not word & 0x82 else QUICK
        elif self.status == FAULT:
            if word & 0x80 and not before & 0x80:
                self.status = OFF
        elif self.status != self.stuck_at:
            self._go(word)

    def _go(self, word: int) -> None:
        status = self.status & ~FOLLOWS
        enabled = ENABLED & ~FOLLOWS
        if status == enabled and word & 0x86 == 0x02:
            self.status, self.left = QUICK, self.braking
        elif word & 0x82 == 0x00:
            self.status = OFF
        elif status == OFF and word & 0x87 == 0x06:
            self.status = READY
        elif status == READY and word & 0x87 == 0x07:
            self.status = ON
        elif status == ON and word & 0x8F == 0x0F:
            self.status = enabled if self.ignores else ENABLED
        elif status == enabled and word & 0x8F == 0x07:
            self.status = ON
        elif status in (ON, enabled) and word & 0x87 == 0x06:
            self.status = READY


class FakeDrives:
    """Implements `Cyclic`: commands are applied one exchange later, as RPDOs are.

    Attributes:
        drives: The axes.
        heard: News to be given next.
        sent_outputs: Per exchange, (controlwords, target positions, target torques).
        slow_s: How long an exchange takes.
        held_up_s: By how much later than said SYNCs go out from now on.
        error: Raised by the next exchange.
    """

    def __init__(self, n: int = 3, mapping: Mapping = ALL_MODES) -> None:
        self.drives = [FakeDrive(1000 * (axis + 1)) for axis in range(n)]
        self.heard = News()
        self.watching = False
        self.cycle, self.sync_time, self.synced_s = -1, 0.0, 0.0
        self.slow_s = self.held_up_s = 0.0
        self.error: Exception | None = None
        self.sent = np.zeros((len(mapping.rpdos), n, 8), np.uint8)
        self.answered = np.zeros((len(mapping.tpdos), n, 8), np.uint8)
        self.sent_outputs: deque[tuple[list[int], list[int], list[int]]] = deque(maxlen=20_000)
        self._next = (([0] * n), ([0] * n))

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        if self.error is not None:
            raise self.error
        self.cycle += 1
        # By cycles, not by the wall: only what a test holds up is late.
        self.sync_time, self.synced_s = time.time(), self.cycle * PERIOD_S + self.held_up_s
        words, modes = self._next
        for drive, word, mode in zip(self.drives, words, modes, strict=True):
            drive.apply(word, mode)
        self._next = (outputs.controlword.copy(), outputs.mode.copy())
        self.sent_outputs.append(
            (
                outputs.controlword.copy(),
                outputs.target_position.copy(),
                outputs.target_torque.copy(),
            )
        )
        self.sent[0, 0, :4] = np.frombuffer(self.cycle.to_bytes(4, "little"), np.uint8)
        if self.slow_s:
            time.sleep(self.slow_s)
        return self.inputs()

    def inputs(self) -> Inputs:
        """What the axes answer now."""
        inputs = Inputs.none_yet(len(self.drives))
        for axis, drive in enumerate(self.drives):
            inputs.statusword[axis] = drive.status
            inputs.position[axis] = drive.position
            inputs.mode_display[axis] = drive.mode
            inputs.torque[axis] = drive.torque
            inputs.fresh[axis] = not drive.silent
        return inputs

    def idle(self, until_s: float) -> None:
        time.sleep(max(until_s - time.monotonic(), 0.0))

    def pump(self, until_s: float) -> None:
        time.sleep(max(until_s - time.monotonic(), 0.0))

    def watch(self, on: bool) -> None:
        self.watching = on

    def news(self) -> News | None:
        news, self.heard = self.heard, News()
        return news if news.any else None


class Rig:
    """A supervisor and drives, cycle by cycle."""

    def __init__(self, n: int = 3, **options: object) -> None:
        self.cyclic = FakeDrives(n)
        self.outputs = Outputs.idle(n)
        self.supervisor = Supervisor(
            tuple(range(11, 11 + n)),
            PERIOD_S,
            self.outputs,
            **options,  # type: ignore[arg-type]
        )

    @property
    def drives(self) -> Sequence[FakeDrive]:
        return self.cyclic.drives

    @property
    def phase(self) -> Phase:
        return self.supervisor.phase

    def cycles(self, count: int = 1) -> None:
        """So many exchanges and steps."""
        for _ in range(count):
            inputs = self.cyclic.exchange(self.outputs, 0.0)
            if (news := self.cyclic.news()) is not None:
                self.supervisor.hear(news)
            self.supervisor.step(inputs, self.cyclic.cycle)

    def until(self, phase: Phase, most: int = 3000) -> int:
        """Cycles until a phase is reached."""
        for count in range(most):
            if self.phase is phase:
                return count
            self.cycles()
        raise AssertionError(f"still {self.phase} after {most} cycles")

    def enable(self, mode: int = CSP) -> None:
        self.cycles(2)
        self.supervisor.enable(mode)
        self.until(Phase.ENABLED)
        self.cycles(3)

    def problem(self, most: int = 200) -> str:
        """What is told within so many cycles."""
        for _ in range(most):
            if problem := self.supervisor.take_problem():
                return problem
            self.cycles()
        return ""
