"""Stops the robot when the control thread does not come round any more."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from types import TracebackType

HUNG_AFTER_S = 3.0
"""Longest time between two blocks on a robot that lives in wall time [s]."""

_LOOKS_PER_LIMIT = 6


class Watchdog:
    """Watches one loop while it is open.

    A driver whose call never returns takes the control thread with it; the stop then has to come
    from elsewhere, and the engine ends the run without that thread.

    Args:
        hung: Called once, on the watchdog's thread, when the loop has not come round in time.
        limit_s: How long that is.
        on: False to watch nothing: on a virtual clock nothing moves while nobody reads.
    """

    def __init__(
        self, hung: Callable[[], object], *, limit_s: float = HUNG_AFTER_S, on: bool = True
    ) -> None:
        self._hung = hung
        self._limit_s = limit_s
        self._last = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hil-watchdog", daemon=True)
        self._on = on

    def feed(self) -> None:
        """The loop has come round."""
        self._last = time.monotonic()

    def be_patient(self, seconds: float) -> None:
        """A call comes that may take so long; until the loop comes round the next time."""
        self._last = time.monotonic() + max(0.0, seconds - self._limit_s)

    def __enter__(self) -> Watchdog:
        self.feed()
        if self._on:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()

    def _run(self) -> None:
        while not self._over.wait(self._limit_s / _LOOKS_PER_LIMIT):
            if time.monotonic() - self._last > self._limit_s:
                with contextlib.suppress(Exception):  # nobody is there to hear of it
                    self._hung()
                return
