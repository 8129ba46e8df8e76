"""Cycle records, written in place by one thread and taken in blocks by another."""

from __future__ import annotations

import contextlib
import struct
import threading
import time
from typing import Any

import numpy as np

from hil.core import FloatArray, StructArray
from hil_drivers.cia402.contracts import Cyclic
from hil_drivers.cia402.mapping import Mapping, cycle_dtype

_CODES = {"<i8": "q", "<f8": "d", "<i4": "i"}


class Ring:
    """A bounded queue of records (`mapping.cycle_dtype`).

    Args:
        mapping: Of every axis.
        n: Axes.
        capacity: Records that may wait.
        batch: So many are waited for before whoever takes is woken.

    Attributes:
        temperature: (n,) [°C]; written by whoever hears the drives tell it.
        forgotten: Records let go because nobody took them.
    """

    def __init__(self, mapping: Mapping, n: int, capacity: int, batch: int = 1) -> None:
        self._rows = np.zeros(capacity, dtype=cycle_dtype(mapping, n))
        self._memory, self._row_bytes = self._rows.view(np.uint8).data, self._rows.itemsize
        self._packing = _packing(self._rows.dtype)
        self._capacity, self._batch = capacity, batch
        self._written = self._taken = 0
        self._asleep = False
        self._bell, self._moving = threading.Lock(), threading.Lock()
        self.temperature: FloatArray = np.full(n, np.nan)
        self._celsius = self.temperature.tobytes()
        self.forgotten = 0

    @property
    def full(self) -> bool:
        """Whether the next record has no room."""
        return self._written - self._taken >= self._capacity

    def begin(self) -> None:
        """A cycle begins: what is known of temperatures now goes into its record.

        Not what is known when it ends: a log of the bus tells what came before a SYNC, but not
        when we were done with the answers to it.
        """
        self._celsius = self.temperature.tobytes()

    def put(self, cyclic: Cyclic, told: tuple[int, int], fault_code: int, flags: int) -> None:
        """Write what the last exchange has left behind; the ring is not full.

        Args:
            cyclic: Has exchanged.
            told: Segment and status that were announced with it.
            fault_code: See `mapping.cycle_dtype`.
            flags: Likewise.
        """
        self._packing.pack_into(
            self._memory,
            self._written % self._capacity * self._row_bytes,
            cyclic.cycle,
            cyclic.sync_time,
            self._celsius,
            *told,
            fault_code,
            flags,
            cyclic.sent.tobytes(),
            cyclic.answered.tobytes(),
        )
        self._written += 1  # from here on it is seen
        if self._asleep and self._written - self._taken >= self._batch:
            self.wake()

    def forget(self, count: int) -> None:
        """Let go of the oldest ones."""
        with self._moving:
            count = min(count, self._written - self._taken)
            self._taken += count
            self.forgotten += count

    def wake(self) -> None:
        """Let whoever waits in `take` have what there is."""
        self._asleep = False
        with contextlib.suppress(RuntimeError):  # it rings already
            self._bell.release()

    def take(self, timeout_s: float) -> StructArray:
        """All that wait, in order; none when none came in time. One thread at a time."""
        if self._written == self._taken:
            self._bell.acquire(blocking=False)
            self._asleep = True
            if self._written == self._taken:
                self._bell.acquire(timeout=timeout_s)
            self._asleep = False
        with self._moving:
            stop = self._written
            block = self._copy(self._taken, stop)
            self._taken = stop  # not before: a full ring is written to again from here on
        return block

    def wait_for_room(self, until_s: float) -> None:
        """Until there is room for a quarter of all, or that `time.monotonic`."""
        while self._written - self._taken > 0.75 * self._capacity and time.monotonic() < until_s:
            time.sleep(0.002)

    def _copy(self, start: int, stop: int) -> StructArray:
        first, last = start % self._capacity, stop % self._capacity
        if first < last or start == stop:
            return self._rows[first:last].copy()
        return np.concatenate([self._rows[first:], self._rows[:last]])


def _packing(row: np.dtype[Any]) -> struct.Struct:
    """Packs a whole record at once; arrays in it as bytes."""
    fields = [row[name] for name in row.names or ()]
    codes = [f"{field.itemsize}s" if field.shape else _CODES[field.str] for field in fields]
    return struct.Struct("<" + "".join(codes))
