"""What is on the bus beside process data: heartbeats, boot-ups, emergencies, errors of the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass

from hil.can import ERROR, ERROR_BUS_OFF, ERROR_CONTROLLER, FRAME, TX_OVERFLOW
from hil_drivers.cia402.contracts import Emergency, News
from hil_drivers.cia402.masters import MasterWatch

EMCY_COB_ID, SDO_ANSWER_COB_ID, HEARTBEAT_COB_ID = 0x080, 0x580, 0x700
"""Predefined connection set: plus the node's id (CiA 301)."""

SILENCE_S = 0.3
"""Device time after which a heartbeat of 100 ms is overdue [s]."""

LOOK_S = 0.01
RX_OVERFLOW = 0x01
_BOOT_UP = 0

Notify = Callable[[int, bytes, float], None]


@dataclass(slots=True)
class Counts:
    """What has gone wrong on the bus.

    Attributes:
        missing: TPDOs that had not come when their cycle was over.
        late: TPDOs of them that came after the next SYNC.
        doubled: TPDOs that came twice in a cycle.
        malformed: TPDOs of another length than mapped.
        foreign: Frames that none of our drives sends.
        overflows: Frames for which there was no room in a transmit or receive queue.
    """

    missing: int = 0
    late: int = 0
    doubled: int = 0
    malformed: int = 0
    foreign: int = 0
    overflows: int = 0


class InARow:
    """Counts cycles in a row in which something happens."""

    def __init__(self) -> None:
        self._last, self._number = -2, 0

    def in_cycle(self, cycle: int) -> int:
        """It happens in a cycle, perhaps again; in how many in a row by now."""
        if cycle != self._last:
            self._number = self._number + 1 if cycle == self._last + 1 else 1
            self._last = cycle
        return self._number


class NodeWatch:
    """Looks at every frame that is no process data, and at the heartbeats that do not come.

    Args:
        nodes: Of our drives.
        tpdos: COB-IDs of their process data.
        counts: Where malformed and foreign frames and overflows are counted.
        notify: Gets every frame but the bus' own errors.
        late_cycles: Cycles in a row in which the bus may have no room for our frames, or in which a
            node may answer twice.

    Attributes:
        counts: As given.
        cycle: The present one, written by the exchange.
        look_at: Device time at which `look` is to be called again [s].
    """

    def __init__(
        self,
        nodes: Sequence[int],
        tpdos: Container[int],
        counts: Counts,
        notify: Notify | None,
        late_cycles: int = 3,
    ) -> None:
        self._tpdos, self.counts, self._notify = tpdos, counts, notify
        self._heartbeats = {HEARTBEAT_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._emergencies = {EMCY_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._answers = frozenset(SDO_ANSWER_COB_ID + node for node in nodes)
        self._news, self._watching = News(), False
        self._heard_s = [0.0] * len(nodes)
        self._silent: set[int] = set()
        self._device_s = self.look_at = 0.0
        self.cycle = -1
        self._nodes, self._late_cycles = tuple(nodes), late_cycles
        self._overflowing, self._doubling = InARow(), [InARow() for _ in nodes]
        self._masters = MasterWatch(nodes)

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups are news, from now on."""
        self._watching = on
        self._heard_s = [self._device_s] * len(self._heard_s)
        self._silent.clear()

    def take_news(self) -> News | None:
        """What has come since it was last asked for; None when there is nothing."""
        if not self._news.any:
            return None
        news, self._news = self._news, News()
        return news

    def heard(self, raw: bytes) -> None:
        """A frame that is no process data of ours as mapped."""
        can_id, length, data = FRAME.unpack(raw)
        if can_id & ERROR:
            self._bus_error(can_id, data)
            return
        if can_id in self._heartbeats:
            self._heartbeat(self._heartbeats[can_id], data)
        elif can_id in self._emergencies:
            self._emergency(self._emergencies[can_id], data)
        elif can_id in self._tpdos:
            self.counts.malformed += 1
        elif can_id not in self._answers:
            self.counts.foreign += 1
            self._foreign(can_id, data)
        if self._notify is not None:
            self._notify(can_id, data[:length], time.time())

    def look(self, device_s: float) -> None:
        """Whose heartbeat is overdue, at a device time [s]."""
        self._device_s, self.look_at = device_s, device_s + LOOK_S
        if not self._watching:
            return
        for axis, heard_s in enumerate(self._heard_s):
            if device_s - heard_s > SILENCE_S and axis not in self._silent:
                self._silent.add(axis)
                self._news.silent.append(axis)

    def overflow(self) -> None:
        """A frame of the present cycle has found no room."""
        self.counts.overflows += 1
        most = self._late_cycles
        if self._overflowing.in_cycle(self.cycle) > most:
            self._news.bus_error = (
                f"the bus had no room for our frames in more than {most} cycles in a row"
            )

    def doubled(self, axis: int) -> None:
        """An answer of an axis came twice in the present cycle, and none was owed."""
        self.counts.doubled += 1
        if self._doubling[axis].in_cycle(self.cycle) > self._late_cycles:
            self._tell(f"two nodes answer as node {self._nodes[axis]}")

    def _foreign(self, can_id: int, data: bytes) -> None:
        if said := self._masters.heard(can_id, data):
            self._tell(said)

    def _tell(self, said: str) -> None:
        """The first of a cycle, while the arm is driven."""
        if self._watching and not self._news.bus_error:
            self._news.bus_error = said

    def _heartbeat(self, axis: int, data: bytes) -> None:
        self._heard_s[axis] = self._device_s
        self._silent.discard(axis)
        if self._watching and data[0] == _BOOT_UP:
            self._news.booted.append(axis)

    def _emergency(self, axis: int, data: bytes) -> None:
        code = int.from_bytes(data[:2], "little")
        self._news.emergencies.append(Emergency(axis, code, data[2], data[3:8]))

    def _bus_error(self, can_id: int, data: bytes) -> None:
        if can_id & ERROR_BUS_OFF:
            self._news.bus_error = "our CAN controller has gone off the bus (bus-off)"
        elif can_id & ERROR_CONTROLLER and data[1] & (TX_OVERFLOW | RX_OVERFLOW):
            self.overflow()
