"""Process data of one node: RPDOs are written into registers, TPDOs are sent from registers.

`Exchange` contains all PDOs of the node, which are triggered by SYNC, events and timers. `Rpdo` and
`Tpdo` are single PDOs with their compiled `Layout`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.access_rules import (
    CAN_ID,
    COB_ID,
    DUMMIES,
    EVENT_TIMER,
    INHIBIT,
    TRANSMISSION,
    cob_id_is_valid,
    mapped,
)
from hil_mock_robot.cia402.bus import Send
from hil_mock_robot.cia402.dictionary import (
    CODES,
    N_PDOS,
    RPDO_MAPPING,
    RPDO_PARAMETERS,
    TPDO_MAPPING,
    TPDO_PARAMETERS,
    by_key,
)
from hil_mock_robot.cia402.keys import Registers, key

TOO_SHORT, TOO_LONG, TIMED_OUT = 0x8210, 0x8220, 0x8250
"""Error codes for RPDOs that are too short, too long or overdue."""


class Exchange:
    """All PDOs of one node.

    Args:
        registers: Live objects of the drive, including all of 1400h … 1A03h.
        send: Function that puts a frame on the bus.
        applied: Callback that is called after RPDOs were written into the registers.

    Attributes:
        missed: Number of consecutive SYNCs without the RPDO with the target position, after its
            first arrival.
    """

    def __init__(self, registers: Registers, send: Send, applied: Callable[[], None]) -> None:
        self._send, self._applied = send, applied
        self._rpdos, self._tpdos = all_rpdos(registers), all_tpdos(registers)
        self._all: list[Rpdo | Tpdo] = [*self._rpdos, *self._tpdos]
        self.configure()

    def configure(self) -> None:
        """Read the parameters and mappings of all PDOs again."""
        for pdo in self._all:
            pdo.configure()
        received = [pdo for pdo in self._rpdos if pdo.cob_id >= 0]
        sent = [pdo for pdo in self._tpdos if pdo.cob_id >= 0]
        self._by_id: dict[int, Rpdo] = {pdo.cob_id: pdo for pdo in received}
        self._applied_by_sync = [pdo for pdo in received if pdo.synchronous]
        leading = [pdo for pdo in self._applied_by_sync if keys.TARGET_POSITION in pdo.keys]
        self._leading = leading[0] if leading else None
        self.lead_by_hand()
        self._by_sync = [pdo for pdo in sent if pdo.synchronous]
        self._by_event = [pdo for pdo in sent if not pdo.synchronous]

    def restart(self) -> None:
        """Clear all received and sent data when the node becomes operational."""
        for pdo in self._all:
            pdo.restart()
        self.lead_by_hand()

    def lead_by_hand(self) -> None:
        """Stop waiting for RPDOs until an RPDO arrives, because a client writes targets by SDO."""
        self._led, self.missed = False, 0

    def receives(self, can_id: int) -> bool:
        """Return whether an identifier is that of an RPDO."""
        return can_id in self._by_id

    def heard(self, can_id: int, data: bytes, now_s: float) -> int:
        """Handle a received RPDO; return an error code, which is 0 if the length is right.

        An RPDO that is too short is ignored. If an RPDO is too long, its surplus bytes are ignored.
        """
        pdo = self._by_id[can_id]
        if len(data) < pdo.length:
            return TOO_SHORT
        pdo.take(data, now_s)
        if not pdo.synchronous and pdo.apply():
            self._applied()
        return TOO_LONG if len(data) > pdo.length else 0

    def synced(self) -> None:
        """Handle SYNC: apply the received RPDOs, then send the synchronous TPDOs."""
        applied = [pdo for pdo in self._applied_by_sync if pdo.apply()]
        if self._leading in applied:
            self._led, self.missed = True, 0
        elif self._led:
            self.missed += 1
        if applied:
            self._applied()
        for pdo in self._by_sync:
            data = pdo.with_sync()
            if data is not None:
                self._send(pdo.cob_id, data)

    def ticked(self, now_s: float) -> bool:
        """Send event-driven TPDOs; return whether an RPDO is overdue."""
        for pdo in self._by_event:
            data = pdo.by_event(now_s)
            if data is not None:
                self._send(pdo.cob_id, data)
        return sum(pdo.overdue(now_s) for pdo in self._by_id.values()) > 0


LAST_CYCLIC = 240
"""Highest transmission type triggered by SYNC; type 0 means SYNC and changed data."""

TICK_TOLERANCE_S = 1e-9


@dataclass(frozen=True, slots=True)
class Layout:
    """Mapping of a PDO (16xxh or 1Axxh), compiled to a `struct` layout and register keys.

    Attributes:
        packing: `struct` layout of all mapped objects.
        keys: Keys of the mapped objects in the registers, without dummies.
    """

    packing: struct.Struct
    keys: tuple[int, ...]

    @classmethod
    def of(cls, registers: Registers, index: int) -> Layout:
        """Return the compiled mapping of the mapping object `index`."""
        raw = (registers[key(index, sub)] for sub in range(1, registers[key(index)] + 1))
        entries = [mapped(entry) for entry in raw]
        codes = "".join(
            f"{bits // 8}x" if (where, bits) in DUMMIES else CODES[by_key()[where].type]
            for where, bits in entries
        )
        keys = tuple(where for where, bits in entries if (where, bits) not in DUMMIES)
        return cls(struct.Struct("<" + codes), keys)


class Rpdo:
    """Receive PDO (RPDO) of a node, which is sent to the drive.

    Args:
        registers: Live objects of the drive.
        number: Number of the PDO, from 0.

    Attributes:
        cob_id: COB-ID of the PDO; −1 while the PDO is not valid.
        synchronous: Whether the PDO is applied at the next SYNC; if False, the PDO is applied
            immediately.
    """

    def __init__(self, registers: Registers, number: int) -> None:
        self._registers, self._index = registers, RPDO_PARAMETERS + number
        self.configure()

    def configure(self) -> None:
        """Read the parameters and the mapping of the RPDO again."""
        registers, index = self._registers, self._index
        self._layout = Layout.of(registers, index - RPDO_PARAMETERS + RPDO_MAPPING)
        self.cob_id = _cob_id(registers, index, self._layout)
        self.synchronous = registers[key(index, TRANSMISSION)] <= LAST_CYCLIC
        self._timeout_s = registers[key(index, EVENT_TIMER)] / 1000
        self.restart()

    def restart(self) -> None:
        """Drop received data."""
        self._waiting: bytes | None = None
        self._heard_s: float | None = None

    @property
    def keys(self) -> tuple[int, ...]:
        """Register keys of the objects in the RPDO."""
        return self._layout.keys

    @property
    def length(self) -> int:
        """Minimum number of data bytes of the RPDO."""
        return self._layout.packing.size

    def take(self, data: bytes, now_s: float) -> None:
        """Store received data of sufficient length, which `apply` writes into the registers."""
        self._waiting, self._heard_s = data, now_s

    def apply(self) -> bool:
        """Write received data into the registers; return whether data had been received."""
        if self._waiting is None:
            return False
        values = self._layout.packing.unpack_from(self._waiting)
        self._registers.update(zip(self._layout.keys, values, strict=True))
        self._waiting = None
        return True

    def overdue(self, now_s: float) -> bool:
        """Return True, only one time, if the event timer has expired since the last reception."""
        if not self._timeout_s or self._heard_s is None:
            return False
        if now_s - self._heard_s <= self._timeout_s + TICK_TOLERANCE_S:
            return False
        self._heard_s = None
        return True


def _cob_id(registers: Registers, index: int, layout: Layout) -> int:
    """Return the COB-ID of a PDO; −1 if the PDO is invalid or has no mapped object."""
    cob_id = registers[key(index, COB_ID)]
    return cob_id & CAN_ID if cob_id_is_valid(cob_id) and layout.keys else -1


class Tpdo:
    """Transmit PDO (TPDO) of a node, which the drive sends.

    Args:
        registers: Live objects of the drive.
        number: Number of the PDO, from 0.

    Attributes:
        cob_id: COB-ID of the PDO; −1 while the PDO is not valid.
        synchronous: Whether the PDO is sent with SYNC; if False, the PDO is sent at events.
    """

    def __init__(self, registers: Registers, number: int) -> None:
        self._registers, self._index = registers, TPDO_PARAMETERS + number
        self.configure()

    def configure(self) -> None:
        """Read the parameters and the mapping of the TPDO again."""
        registers, index = self._registers, self._index
        self._layout = Layout.of(registers, index - TPDO_PARAMETERS + TPDO_MAPPING)
        self.cob_id = _cob_id(registers, index, self._layout)
        self._type = registers[key(index, TRANSMISSION)]
        self.synchronous = self._type <= LAST_CYCLIC
        self._inhibit_s = registers[key(index, INHIBIT)] / 10_000
        self._event_s = registers[key(index, EVENT_TIMER)] / 1000
        self.restart()

    def restart(self) -> None:
        """Reset the count of SYNCs and treat all data as changed."""
        self._syncs = 0
        self._sent: bytes | None = None
        self._sent_s = 0.0

    def with_sync(self) -> bytes | None:
        """Return the data to send with a SYNC; None if the TPDO is not sent at this SYNC."""
        if self._type == 0:
            data = self._sample()
            if data == self._sent:
                return None
            self._sent = data
            return data
        self._syncs += 1
        if self._syncs < self._type:
            return None
        self._syncs = 0
        return self._sample()

    def by_event(self, now_s: float) -> bytes | None:
        """Return the data to send after a change or when the event timer has expired, else None."""
        waited_s = now_s - self._sent_s + TICK_TOLERANCE_S
        if self._sent is not None and waited_s < self._inhibit_s:
            return None
        data = self._sample()
        if data == self._sent and not 0 < self._event_s <= waited_s:
            return None
        self._sent, self._sent_s = data, now_s
        return data

    def _sample(self) -> bytes:
        registers = self._registers
        return self._layout.packing.pack(*[registers[where] for where in self._layout.keys])


def all_rpdos(registers: Registers) -> list[Rpdo]:
    """Return all RPDOs of a node in the order of their numbers."""
    return [Rpdo(registers, number) for number in range(N_PDOS)]


def all_tpdos(registers: Registers) -> list[Tpdo]:
    """Return all TPDOs of a node in the order of their numbers."""
    return [Tpdo(registers, number) for number in range(N_PDOS)]
