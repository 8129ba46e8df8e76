"""Waiting for what another thread or process does, with a bound that a busy machine keeps."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

Seen = TypeVar("Seen")


def until(look: Callable[[], Seen], within_s: float = 60.0, every_s: float = 0.005) -> Seen:
    """Return the first true value of a look.

    Args:
        look: Asked again and again.
        within_s: How long, much longer than it takes on an idle machine [s].
        every_s: Pause between two looks [s].

    Raises:
        AssertionError: It never was; the message says how busy the machine is.
    """
    end = time.monotonic() + within_s
    while not (seen := look()):
        if time.monotonic() > end:
            load, cores = os.getloadavg()[0], os.cpu_count()
            raise AssertionError(f"not within {within_s:g} s (load {load:.1f} on {cores} cores)")
        time.sleep(every_s)
    return seen
