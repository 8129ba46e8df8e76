"""Cycle records, written in place by one thread and taken in blocks by another."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from hil.typing import FloatArray, StructArray
from hil_drivers.cia402.contracts import Cyclic
from hil_drivers.cia402.mapping import Mapping, cycle_dtype


class Ring:
    """A bounded queue of records (`mapping.cycle_dtype`).

    Args:
        mapping: Of every axis.
        n: Axes.
        capacity: Records that may wait.
        batch: So many are waited for before whoever takes is woken.

    Attributes:
        temperature: (n,) [°C], goes into every record; written by whoever asks the drives for it.
        forgotten: Records let go because nobody took them.
    """

    def __init__(self, mapping: Mapping, n: int, capacity: int, batch: int = 1) -> None:
        self._rows = np.zeros(capacity, dtype=cycle_dtype(mapping, n))
        self._columns: dict[str, Any] = {name: self._rows[name] for name in _names(self._rows)}
        self._capacity, self._batch = capacity, batch
        self._written = self._taken = 0
        self._asleep = False
        self._changed = threading.Condition()
        self.temperature: FloatArray = np.full(n, np.nan)
        self.forgotten = 0

    @property
    def full(self) -> bool:
        """Whether the next record has no room."""
        return self._written - self._taken >= self._capacity

    def put(self, cyclic: Cyclic, told: tuple[int, int], fault_code: int, flags: int) -> None:
        """Write what the last exchange has left behind; the ring is not full.

        Args:
            cyclic: Has exchanged.
            told: Segment and status that were announced with it.
            fault_code: See `mapping.cycle_dtype`.
            flags: Likewise.
        """
        at, columns = self._written % self._capacity, self._columns
        columns["cycle"][at] = cyclic.cycle
        columns["host_time"][at] = cyclic.sync_time
        columns["temperature"][at] = self.temperature
        columns["segment"][at], columns["status"][at] = told
        columns["fault_code"][at] = fault_code
        columns["flags"][at] = flags
        columns["rpdo"][at] = cyclic.sent
        columns["tpdo"][at] = cyclic.answered
        self._written += 1  # from here on it is seen
        if self._asleep and self._written - self._taken >= self._batch:
            self.wake()

    def forget(self, count: int) -> None:
        """Let go of the oldest ones."""
        with self._changed:
            count = min(count, self._written - self._taken)
            self._taken += count
            self.forgotten += count

    def wake(self) -> None:
        """Let whoever waits in `take` have what there is."""
        with self._changed:
            self._asleep = False
            self._changed.notify_all()

    def take(self, timeout_s: float) -> StructArray:
        """All that wait, in order; none when none came in time."""
        with self._changed:
            self._asleep = self._written == self._taken
            self._changed.wait_for(lambda: not self._asleep, timeout_s)
            self._asleep = False
            start, stop = self._taken, self._written
            at = np.arange(start, stop) % self._capacity
            block = self._rows[at]
            self._taken = stop
        return block

    def wait_for_room(self, until_s: float) -> None:
        """Until there is room for a quarter of all, or that `time.monotonic`."""
        while self._written - self._taken > 0.75 * self._capacity and time.monotonic() < until_s:
            time.sleep(0.002)


def _names(rows: StructArray) -> tuple[str, ...]:
    names = rows.dtype.names
    assert names is not None
    return names
