"""When a blackout begins, nothing may be under way: what is, is stopped as by SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from datetime import UTC, datetime

from hil.maintenance.schedule.loop import Interruption

_LOOK_EVERY_S = 1.0


@contextlib.contextmanager
def curfew(moment: datetime | None) -> Iterator[None]:
    """Interrupt what is done inside when a moment of the wall clock comes.

    A run stops its robot safely and can be gone on with, as after `kill`. Does nothing outside the
    main thread, where runs do not hear signals.

    Raises:
        Interruption: The moment came.
    """
    if moment is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    over, rung = threading.Event(), threading.Event()
    watch = threading.Thread(
        target=_ring_at, args=(moment, over, rung), name="hil-curfew", daemon=True
    )
    before = signal.getsignal(signal.SIGTERM)
    if before is signal.SIG_DFL:  # it would end the process
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    watch.start()
    try:
        try:
            yield
        finally:
            over.set()
            watch.join()
    except BaseException as error:
        if rung.is_set():
            raise Interruption("a blackout began") from error
        raise
    finally:
        if before is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, before)


def _ring_at(moment: datetime, over: threading.Event, rung: threading.Event) -> None:
    while not over.is_set():
        left_s = (moment - datetime.now(UTC)).total_seconds()
        if left_s <= 0:
            rung.set()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            return
        over.wait(min(left_s, _LOOK_EVERY_S))
