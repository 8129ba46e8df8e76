"""Stops: written on a line of their own, and looked for in what the PLC's program shows."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from hil.core import HilError, RobotTimeout
from hil_drivers.twincat.line import Line
from hil_drivers.twincat.variables import Variables

WRITTEN_WITHIN_S, SEEN_WITHIN_S = 0.05, 0.09
"""Until when a stop is written again, and until when the PLC has to show that it has seen it,
counted from the call [s]."""

MODULO = 2**32


class Stops:
    """Counts in `nStop`, where any change is a stop.

    Args:
        variables: Of the PLC.
        line: To write and look on.
    """

    def __init__(self, variables: Variables, line: Line) -> None:
        self._variables, self._line = variables, line
        self._last = int(variables.structure("nStop"))
        self._given = self._under_way = 0
        self._counting, self._writing = threading.Lock(), threading.Lock()

    def before_start(self) -> tuple[np.void, int]:
        """`stState`, and the `nStop` with which a start is obeyed: whoever has written it."""
        with self._counting:
            given, under_way = self._given, self._under_way
        state = self._variables.structure("stState")
        seen = int(state["nStop"])
        with self._counting:
            # Never back behind a stop of ours: the next one would be no change.
            if given == self._given and not under_way:
                self._last = seen
        return state, seen

    def give(self) -> None:
        """Write one, and wait until the PLC shows that its program has seen it; by any thread.

        Raises:
            RobotTimeout: It does not show that.
            RobotError: It could not be written.
        """
        began = time.monotonic()
        with self._counting:
            value = self._last = (self._last + 1) % MODULO
            self._given += 1
            self._under_way += 1
        try:
            _until(began + WRITTEN_WITHIN_S, self._write)
            _until(began + SEEN_WITHIN_S, lambda: self._require_seen(value))
        finally:
            with self._counting:
                self._under_way -= 1

    def _write(self) -> None:
        """One thread after the other, and the newest number: `nStop` never goes back."""
        with self._writing:
            number = self._last.to_bytes(4, "little")
            self._line.write(self._variables.handle("nStop"), number)

    def _require_seen(self, value: int) -> None:
        """The PLC shows this stop, or one that another thread has given since."""
        seen = int(self._variables.structure("stState", self._line)["nStop"])
        if (self._last - seen) % MODULO > (self._last - value) % MODULO:
            raise RobotTimeout(
                f"its program shows stop {seen}, not {value}",
                hint="stop the arm by its own means, then look at the PLC program",
            )


def _until(until: float, act: Callable[[], None]) -> None:
    """Threads share the line, which may refuse one of them: try again."""
    while True:
        try:
            return act()
        except HilError:
            if time.monotonic() >= until:
                raise
        time.sleep(0.001)
