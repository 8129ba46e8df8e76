"""Observers see what happens and cannot hurt what moves.

Each observer lives on its own thread behind a bounded queue. When it is slow the oldest event is
dropped, when it raises it is switched off and the reason kept, and the control thread never waits.
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
    """Something that follows a run: a progress line, a plot, a live view.

    One that also has a true attribute `wants_rows` is given every block as an event of the kind
    `rows`; it must not change the array. With `rows_every_s` it is given one block in that time,
    and none of the others.
    """

    def notify(self, event: Event) -> None:
        """Take an event; called on the observer's own thread, one event at a time."""


DEPTH = 256
"""Events that may wait for one observer."""


class ObserverThread:
    """Isolates one observer."""

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
        """Whether it keeps up: blocks must not push events out of its queue that come only once."""
        return self._events.qsize() < self._events.maxsize // 2

    def offer_rows(self, rows: StructArray) -> None:
        """Hand over a block if it wants one now and keeps up."""
        if not (self.wants_rows and self.has_room):
            return
        if self._rows_every_s:
            now = time.monotonic()
            if now < self._next_rows:
                return
            self._next_rows = now + self._rows_every_s
        self.offer({"kind": "rows", "rows": rows})

    def offer(self, event: Event | None) -> None:
        """Hand over an event without ever waiting."""
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
        """Let it finish what is queued, but not for longer than `timeout_s`."""
        self.offer(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (event := self._events.get()) is not None:
            if self.failure is None:
                try:
                    self._observer.notify(event)
                except Exception as error:  # an observer may fail in any way it likes
                    self.failure = error


class Observers:
    """All observers of one run."""

    def __init__(self, observers: tuple[Observer, ...] = ()) -> None:
        self._threads = [ObserverThread(observer) for observer in observers]

    def add(self, observer: Observer) -> None:
        """Add an observer from now on; not while another thread publishes."""
        self._threads.append(ObserverThread(observer))

    def publish(self, event: Event) -> None:
        """Offer an event to every observer."""
        for thread in self._threads:
            thread.offer(event)

    def publish_rows(self, rows: StructArray) -> None:
        """Offer a block to the observers that want blocks."""
        for thread in self._threads:
            thread.offer_rows(rows)

    def close(self) -> list[str]:
        """End all observers; return what went wrong with any of them."""
        for thread in self._threads:
            thread.close()
        return self.problems()

    def problems(self) -> list[str]:
        """Return what has gone wrong with any of them so far."""
        failures = [f"observer failed: {t.failure!r}" for t in self._threads if t.failure]
        return failures + [f"observer lost {t.dropped} events" for t in self._threads if t.dropped]
