"""The clocks: how finely they tick, whether the date can be right, and who keeps it."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from hil.doctor.finding import Finding

COARSE_S = 1e-3
FIRST_YEAR = 2025
"""No computer has had this program before."""

DAY_S = 86400.0
TIME_ERROR = 5
"""What adjtimex(2) returns of a clock that nobody keeps."""


def resolution() -> Iterator[Finding]:
    """Of the clock that motion and recordings go by."""
    finest_s = time.get_clock_info("monotonic").resolution
    coarse = finest_s > COARSE_S
    text = f"monotonic, {finest_s * 1e9:.0f} ns"
    if coarse:
        text += ": too coarse to keep a driver's cycle by"
    yield Finding("clock", text, "note" if coarse else "ok")


def date() -> Iterator[Finding]:
    """Whether it can be today: runs are named by the date, and schedules go by it."""
    now = time.time()
    told = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
    mend = "set the clock: runs are named by it, and schedules go by it"
    if time.gmtime(now).tm_year < FIRST_YEAR:
        yield Finding("date", f"{told} cannot be; {mend}", "bad")
    elif now + DAY_S < Path(__file__).stat().st_mtime:
        yield Finding("date", f"{told} is before hil was installed; {mend}", "note")
    else:
        yield Finding("date", told)


def synchronised() -> Iterator[Finding]:
    """Whether the kernel knows of anybody who keeps the clock, such as NTP."""
    kept = _kept()
    if kept is None:
        yield Finding("time service", "cannot be told on this system", "note")
    elif kept:
        yield Finding("time service", "the clock is synchronised")
    else:
        mend = "timedatectl set-ntp true, or chrony, has it kept; recordings tell time by it"
        yield Finding("time service", f"the clock is not synchronised: {mend}", "note")


def _kept() -> bool | None:
    if not sys.platform.startswith("linux"):
        return None
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (AttributeError, OSError):
        return None
    # struct timex with modes = 0: nothing is set. It has 208 bytes on 64-bit Linux.
    state = adjtimex(ctypes.create_string_buffer(512))
    if state < 0:
        return None
    return int(state) != TIME_ERROR or os.path.exists("/run/systemd/timesync/synchronized")
