"""Frames taken from the bus while there are no cycles yet, so that SDO requests are answered."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from hil.core import HilError
from hil_drivers.cia402.contracts import Cyclic

AT_ONCE_S = 0.02


@contextmanager
def pumping(cyclic: Cyclic) -> Iterator[None]:
    """Take what comes, in a thread, while the block runs.

    Raises:
        RobotConnectionError: The bus is gone; in place of whatever came of that in the block.
    """
    over, gone = threading.Event(), list[HilError]()

    def pump() -> None:
        try:
            while not over.is_set():
                cyclic.pump(time.monotonic() + AT_ONCE_S)
        except HilError as error:
            gone.append(error)

    thread = threading.Thread(target=pump, name="hil-can-pump", daemon=True)
    thread.start()
    try:
        yield
    except HilError as error:
        raise (gone or [error])[0] from error
    finally:
        over.set()
        thread.join()
    if gone:
        raise gone[0]
