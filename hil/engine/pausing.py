"""Pausing at a checkpoint and going on: the arm holds, reading and judging go on."""

from __future__ import annotations

import time
from collections.abc import Callable

from hil.core import InterlockTripped
from hil.engine.reading import Reading, Sink
from hil.engine.states import RunState
from hil.engine.steps import Steps

CLEAR_FOR_S = 5.0
"""Device time an interlock that pauses must be clear before the run goes on by itself [s]."""

UNATTENDED_S = 3600.0
"""Device time for which interlocks may pause a run that no operator attends [s]: a hot joint cools
down in less, whereas a speed slider or a full disk stays as it is until a person is notified."""

UNHURRIED_BLOCKS = 200
SLOWLY_S = 0.1
"""Wall time a block takes on a virtual clock once a pause has become a long one [s]."""

GoOn = Callable[[], str]
"""Looks, without waiting, whether somebody at the robot lets the run go on: who, or nothing."""


def nobody_goes_on() -> str:
    """There is no console: only a request lets the run go on."""
    return ""


class Pausing:
    """Pauses a run when it was asked to.

    Args:
        reading: Reads, records and judges meanwhile.
        steps: Parks the arm.
        sink: Receives events.
        enter: Brings the run into a state, with the reason.
        go_on: Looks whether somebody at the robot lets the run go on.
    """

    def __init__(
        self,
        reading: Reading,
        steps: Steps,
        sink: Sink,
        enter: Callable[[RunState, str], object],
        go_on: GoOn = nobody_goes_on,
    ) -> None:
        self._reading = reading
        self._requests = reading.requests
        self._steps = steps
        self._sink = sink
        self._enter = enter
        self._go_on = go_on

    def pause_if_asked(self) -> None:
        """Hold until nobody wants a pause any more; nothing happens when nobody does.

        Raises:
            InterlockTripped: No operator attends the run, and an interlock has held it for long.
            HilError: What ended the run while it was paused: a stop, a trip, a fault.
        """
        if not self._requests.why_paused:
            return
        self._steps.park()
        self._requests.resumed_by = ""
        self._enter(RunState.PAUSED, self._requests.why_paused)
        self._hold()
        who = self._requests.resumed_by or "interlocks clear"
        self._sink.event("resumed", by=who)
        self._enter(RunState.RUNNING, f"resumed by {who}")

    def _hold(self) -> None:
        told = self._requests.why_paused
        clear_since: float | None = None
        waiting_since: float | None = None
        attended = self._go_on is not nobody_goes_on
        blocks = 0
        while self._requests.why_paused:
            block = self._reading.block()
            blocks += 1
            if not self._reading.wall and blocks > UNHURRIED_BLOCKS and waiting_since is None:
                # Nobody has to wait through a night of a virtual clock, nor to record it.
                time.sleep(SLOWLY_S)
            if self._requests.pause and (who := self._go_on()):
                self._requests.pause, self._requests.resumed_by = "", who
            if self._requests.held:
                clear_since = self._since(clear_since) if self._reading.judge.clear(block) else None
                if clear_since is not None and self._now - clear_since >= CLEAR_FOR_S:
                    self._requests.held = ""
            # A pause that a person asked for is ended by a person, who can see the interlock too.
            waits = bool(self._requests.held) and not (attended or self._requests.pause)
            waiting_since = self._since(waiting_since) if waits else None
            if waiting_since is not None and self._now - waiting_since >= UNATTENDED_S:
                raise self._left_alone()
            if (why := self._requests.why_paused) and why != told:
                self._sink.event("paused", reason=why)
                told = why

    def _left_alone(self) -> InterlockTripped:
        return InterlockTripped(
            f"{self._requests.held}; paused for {UNATTENDED_S / 60:g} min without it being clear, "
            "and no operator attends the run",
            hint="remove the cause at the robot, then resume the run",
        )

    @property
    def _now(self) -> float:
        return self._reading.progress.last

    def _since(self, since: float | None) -> float:
        return self._now if since is None else since
