"""A bus in a thread of its own, for tests and tools that host one beside their work."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.can.hub import Hub

_ROUND_S = 0.02
_PATIENCE_S = 10.0


class HostedHub:
    """A hub that a thread serves.

    Args:
        hub: Whose; nobody else may touch it.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._asked: queue.SimpleQueue[tuple[Callable[[Hub], Any], Future[Any]]]
        self._asked = queue.SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="hil-can-hub", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """Of its socket: the channel for those who connect."""
        return self._hub.path

    def ask(self, action: Callable[[Hub], Any]) -> Any:
        """Do something with the hub between two rounds; waits, and returns or raises what it does.

        Raises:
            TimeoutError: The thread does not serve any more.
        """
        done: Future[Any] = Future()
        self._asked.put((action, done))
        return done.result(_PATIENCE_S)

    def close(self) -> None:
        """End the thread and the bus. Idempotent."""
        self._ended.set()
        self._thread.join()
        self._hub.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            while not self._asked.empty():
                self._answer(*self._asked.get())
            self._hub.serve(_ROUND_S)

    def _answer(self, action: Callable[[Hub], Any], done: Future[Any]) -> None:
        try:
            done.set_result(action(self._hub))
        except Exception as error:
            done.set_exception(error)


@contextmanager
def hub_thread(
    channel: str | os.PathLike[str], *, bitrate: float | None = None, speed: float = 1.0
) -> Iterator[HostedHub]:
    """Host a bus while the block runs; arguments and errors of `Hub`."""
    hosted = HostedHub(Hub(channel, bitrate=bitrate, speed=speed))
    try:
        yield hosted
    finally:
        hosted.close()
