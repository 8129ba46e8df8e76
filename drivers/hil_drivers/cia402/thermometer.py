"""Temperatures of the motors, asked for one by one beside the cycles: not all drives tell them."""

from __future__ import annotations

import time

from hil.errors import HilError
from hil.typing import FloatArray
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.objects import Entry

EVERY_S = 1.0
"""How often each axis is asked [s]; motors warm up over minutes."""

AFTER_SILENCE_S = 10.0
"""How long nobody is asked after one has not answered: asking takes time-outs [s]."""

CELSIUS_PER_COUNT = 0.1


class Thermometer:
    """Asks for one temperature at a time, in turns.

    Args:
        acyclic: The drives.
        index: Vendor object of every drive, INTEGER16 in 0.1 °C; 0 where there is none.
        celsius: (n,) is written to [°C]; NaN where nothing is known.
    """

    def __init__(self, acyclic: Acyclic, index: int, celsius: FloatArray) -> None:
        self._acyclic, self._celsius = acyclic, celsius
        self._entry = Entry("temperature", index, 0, "h", "0.1 °C")
        self._axis, self._next_s = 0, 0.0

    def ask_all(self) -> None:
        """Ask every axis now, so that the first sample has its temperatures."""
        if all(self._ask() for _ in self._celsius):
            self._next_s = time.monotonic() + EVERY_S / len(self._celsius)

    def look(self) -> None:
        """Ask the axis whose turn it is, if it is time; never raises."""
        now = time.monotonic()
        if now >= self._next_s:
            self._next_s = now + EVERY_S / len(self._celsius)
            self._ask()

    def _ask(self) -> bool:
        if not self._entry.index:
            return False
        axis, self._axis = self._axis, (self._axis + 1) % len(self._celsius)
        try:
            told = self._acyclic.upload(axis, self._entry)
        except HilError:
            self._next_s = time.monotonic() + AFTER_SILENCE_S
            return False
        self._celsius[axis] = told * CELSIUS_PER_COUNT
        return True
