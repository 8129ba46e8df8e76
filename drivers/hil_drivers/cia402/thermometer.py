"""Temperatures of the motors, asked for one by one beside the cycles: not all drives tell them."""

from __future__ import annotations

import time

from hil_drivers.cia402.at_once import AtOnce
from hil_drivers.cia402.objects import Entry

EVERY_S = 1.0
"""How often each axis is asked [s]; motors warm up over minutes."""

FIRST_S = 0.2
"""How long the first answers of all axes are waited for [s]."""


class Thermometer:
    """Asks for one temperature at a time, in turns; `Temperatures` hears the answers.

    Args:
        drives: Who is asked; nobody waits for their answers.
        index: Vendor object of every drive, INTEGER16 in 0.1 °C; 0 where there is none.
        n: Number of axes.
    """

    def __init__(self, drives: AtOnce, index: int, n: int) -> None:
        self._drives, self._n = drives, n
        self._entry = Entry("temperature", index, 0, "h", "0.1 °C")
        self._axis, self._next_s = 0, 0.0

    def ask_all(self) -> None:
        """Ask every axis now, so that the first sample has its temperatures."""
        if self._entry.index:
            self._drives.read(self._entry, range(self._n), FIRST_S)
            self._next_s = time.monotonic() + EVERY_S / self._n

    def look(self) -> None:
        """Ask the axis whose turn it is, if it is time; never raises, does not wait."""
        now = time.monotonic()
        if now < self._next_s or not self._entry.index:
            return
        self._next_s = now + EVERY_S / self._n
        self._drives.read(self._entry, [self._axis])
        self._axis = (self._axis + 1) % self._n
