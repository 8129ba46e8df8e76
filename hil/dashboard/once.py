"""What is sent twice is done once: a double click, or a page that is sent again, starts one run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from concurrent.futures import Future

KEPT_S = 600.0
MOST = 1000
"""Remembered at the same time; the oldest are forgotten first."""


class Once:
    """Remembers for some minutes what came of what was sent; safe from any thread.

    Args:
        kept_s: How long [s].
    """

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_s = kept_s
        self._looking = threading.Lock()
        self._came: dict[Hashable, tuple[float, Future[str]]] = {}

    def of(self, sent: Hashable, do: Callable[[], str]) -> str:
        """What `do` returned when this was sent first; what raised is done again.

        Args:
            sent: What tells it from everything else that is sent.
            do: Does it. Whoever sends the same meanwhile waits for what comes of it, and nobody
                else does.
        """
        mine: Future[str] = Future()
        with self._looking:
            self._forget()
            _, came = self._came.setdefault(sent, (time.monotonic(), mine))
        if came is mine:
            self._do(sent, do, mine)
        return came.result()

    def _do(self, sent: Hashable, do: Callable[[], str], mine: Future[str]) -> None:
        try:
            mine.set_result(do())
        except BaseException as error:  # also to those that wait
            with self._looking:
                self._came.pop(sent, None)
            mine.set_exception(error)

    def _forget(self) -> None:
        until = time.monotonic() - self._kept_s
        old = [sent for sent, (when, _) in self._came.items() if when < until]
        for sent in old or list(self._came)[: -MOST + 1]:
            del self._came[sent]
