"""The PC's heartbeat: as long as it is written, the PLC lets the arm move."""

from __future__ import annotations

import threading
from collections.abc import Callable

from hil.core import HilError

EVERY_S = 0.04


class Beat:
    """A thread that writes a counter; it dies with this process, and the PLC notices.

    Args:
        write: Writes session and count.
        session: Our number.

    Attributes:
        problem: What went wrong with the last beat that did; the PLC stops the arm without them.
    """

    def __init__(self, write: Callable[[int, int], None], session: int) -> None:
        self._write, self._session = write, session
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._count = 0
        self.problem: HilError | None = None

    def start(self) -> None:
        """Go on writing."""
        self._thread = threading.Thread(target=self._run, name="beat to the PLC", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread is not None and self._thread.is_alive() and not self._over.is_set()

    def hush(self) -> None:
        """Fall silent, without waiting for a beat that is on its way."""
        self._over.set()

    def end(self) -> None:
        """Fall silent; idempotent."""
        self.hush()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def _run(self) -> None:
        while not self._over.is_set():
            self._count = self._count % 0xFFFFFFFF + 1
            try:
                self._write(self._session, self._count)
            except HilError as error:
                if self._over.is_set():
                    return
                self.problem = error
                if not isinstance(error, TimeoutError):
                    return
                # It may answer again, or be less busy; whether that is too late, the PLC decides.
            self._over.wait(EVERY_S)
