"""Ctrl-C and SIGTERM become stop requests, not exceptions in the middle of a command."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from hil.engine.engine import Engine

WATCHED = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_on_signals(engine: Engine) -> Iterator[None]:
    """While inside, the first signal asks the engine to stop, the next raises KeyboardInterrupt.

    Signal handlers can only be set in the main thread; elsewhere this changes nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    seen: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        if len(seen) > 1:
            raise KeyboardInterrupt
        engine.request_stop(f"stopped by {signal.Signals(number).name}", by_signal=True)

    before = {number: signal.signal(number, handle) for number in WATCHED}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
