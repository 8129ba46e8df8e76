"""Temperatures of the motors, asked for one by one beside the cycles: not all drives tell them."""

from __future__ import annotations

import time

from hil.errors import HilError
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.objects import Entry

EVERY_S = 1.0
"""How often each axis is asked [s]; motors warm up over minutes."""

AFTER_SILENCE_S = 10.0
"""How long nobody is asked after one has not answered: asking takes time-outs [s]."""


class Thermometer:
    """Asks for one temperature at a time, in turns; `Temperatures` hears the answers.

    Args:
        acyclic: The drives.
        index: Vendor object of every drive, INTEGER16 in 0.1 °C; 0 where there is none.
        n: Number of axes.
    """

    def __init__(self, acyclic: Acyclic, index: int, n: int) -> None:
        self._acyclic, self._n = acyclic, n
        self._entry = Entry("temperature", index, 0, "h", "0.1 °C")
        self._axis, self._next_s = 0, 0.0

    def ask_all(self) -> None:
        """Ask every axis now, so that the first sample has its temperatures."""
        if all(self._ask() for _ in range(self._n)):
            self._next_s = time.monotonic() + EVERY_S / self._n

    def look(self) -> None:
        """Ask the axis whose turn it is, if it is time; never raises."""
        now = time.monotonic()
        if now >= self._next_s:
            self._next_s = now + EVERY_S / self._n
            self._ask()

    def _ask(self) -> bool:
        if not self._entry.index:
            return False
        axis, self._axis = self._axis, (self._axis + 1) % self._n
        try:
            self._acyclic.upload(axis, self._entry)
        except HilError:
            self._next_s = time.monotonic() + AFTER_SILENCE_S
            return False
        return True
