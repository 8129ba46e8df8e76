"""What the programs of the drives' end have in common: they go on until their input ends."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable

LOOK_S = 0.2


def forbid_priority() -> None:
    """From now on this process has the ordinary priority, whatever it asks for."""
    os.sched_setscheduler = _not_permitted


def until_over(serve: Callable[[float], object]) -> None:
    """Say that all is ready, and serve.

    Args:
        serve: Returns after so long at the latest [s].
    """
    print("ready", flush=True)
    over = select.poll()
    over.register(sys.stdin, select.POLLIN | select.POLLHUP)
    look_at = 0.0
    while time.monotonic() < look_at or not over.poll(0):
        if time.monotonic() >= look_at:
            look_at = time.monotonic() + LOOK_S
        serve(LOOK_S)


def _not_permitted(*_: object) -> None:
    raise PermissionError("as on a machine on which nobody has permitted real-time priority")
