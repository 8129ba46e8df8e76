"""Observers of a run; an observer that fails or is slow cannot affect the control thread.

Each observer runs on a separate thread with a bounded queue. If an observer is slow, the oldest
event in its queue is dropped. If an observer raises an exception, it is switched off and the
exception is stored. The control thread never waits for an observer.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from typing import Protocol

from hil.core import StructArray
from hil.engine.standing import Event


class Observer(Protocol):
    """Receiver of the events of a run, such as a progress line, a plot or a live view.

    An observer with a true attribute `wants_rows` also receives every block of rows, as an event of
    the kind `rows`; the observer must not change the array of rows. An observer with the attribute
    `rows_every_s` receives only one block per `rows_every_s` seconds.
    """

    def notify(self, event: Event) -> None:
        """Process an event; called on the thread of the observer for one event at a time."""


DEPTH = 256
"""Maximum number of queued events per observer."""


class ObserverThread:
    """Thread and queue through which one observer receives events."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.wants_rows = bool(getattr(observer, "wants_rows", False))
        self._rows_every_s = float(getattr(observer, "rows_every_s", 0.0))
        self._next_rows = 0.0
        self._events: queue.Queue[Event | None] = queue.Queue(DEPTH)
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self.dropped = 0
        self.failure: BaseException | None = None
        self._thread.start()

    @property
    def has_room(self) -> bool:
        """Whether the event queue is less than half full.

        If the queue were full, events that occur only a single time in a run would be lost.
        """
        return self._events.qsize() < self._events.maxsize // 2

    def offer_rows(self, rows: StructArray) -> None:
        """Queue a block of rows if the observer wants one now and its queue has space."""
        if not (self.wants_rows and self.has_room):
            return
        if self._rows_every_s:
            now = time.monotonic()
            if now < self._next_rows:
                return
            self._next_rows = now + self._rows_every_s
        self.offer({"kind": "rows", "rows": rows})

    def offer(self, event: Event | None) -> None:
        """Queue an event for the observer without waiting."""
        while True:
            try:
                self._events.put_nowait(event)
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._events.get_nowait()
                    self.dropped += 1
            else:
                return

    def close(self, timeout_s: float = 1.0) -> None:
        """Wait at most `timeout_s` until all queued events are processed."""
        self.offer(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (event := self._events.get()) is not None:
            if self.failure is None:
                try:
                    self._observer.notify(event)
                except Exception as error:  # an observer can raise any exception
                    self.failure = error


class Observers:
    """Group of all observers of one run."""

    def __init__(self, observers: tuple[Observer, ...] = ()) -> None:
        self._threads = [ObserverThread(observer) for observer in observers]

    def add(self, observer: Observer) -> None:
        """Add an observer for all later events.

        The method must not be called while a different thread publishes an event.
        """
        self._threads.append(ObserverThread(observer))

    def publish(self, event: Event) -> None:
        """Queue an event for every observer."""
        for thread in self._threads:
            thread.offer(event)

    def publish_rows(self, rows: StructArray) -> None:
        """Queue a block of rows for the observers that want blocks."""
        for thread in self._threads:
            thread.offer_rows(rows)

    def close(self) -> list[str]:
        """Stop all observers; return descriptions of their problems."""
        for thread in self._threads:
            thread.close()
        return self.problems()

    def problems(self) -> list[str]:
        """Return descriptions of the problems of all observers so far."""
        failures = [f"observer failed: {t.failure!r}" for t in self._threads if t.failure]
        return failures + [f"observer lost {t.dropped} events" for t in self._threads if t.dropped]
