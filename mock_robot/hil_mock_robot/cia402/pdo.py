"""Process data of one node: RPDOs into the registers, TPDOs out of them.

`Exchange` is what the node uses: all PDOs, by SYNC, by events and by timers. `Rpdo` and `Tpdo` are
single PDOs with their compiled `Layout`.
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
"""Error codes of RPDOs."""


class Exchange:
    """RPDOs in, TPDOs out.

    Args:
        registers: Live; all of 1400h … 1A03h in it.
        send: Puts a frame on the bus.
        applied: Called after RPDOs have been written into the registers.

    Attributes:
        missed: SYNCs in a row for which the RPDO with the target position had not come, after it
            has come once.
    """

    def __init__(self, registers: Registers, send: Send, applied: Callable[[], None]) -> None:
        self._send, self._applied = send, applied
        self._rpdos, self._tpdos = all_rpdos(registers), all_tpdos(registers)
        self._all: list[Rpdo | Tpdo] = [*self._rpdos, *self._tpdos]
        self.configure()

    def configure(self) -> None:
        """Read parameters and mappings anew."""
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
        """The node becomes operational: nothing has come, nothing was sent."""
        for pdo in self._all:
            pdo.restart()
        self.lead_by_hand()

    def lead_by_hand(self) -> None:
        """A client writes targets by SDO: RPDOs are not waited for, until one comes."""
        self._led, self.missed = False, 0

    def receives(self, can_id: int) -> bool:
        """Whether this is the identifier of an RPDO."""
        return can_id in self._by_id

    def heard(self, can_id: int, data: bytes, now_s: float) -> int:
        """Handle an RPDO; return its error code, 0 if it is right.

        What is too short is not taken, of what is too long the rest is left.
        """
        pdo = self._by_id[can_id]
        if len(data) < pdo.length:
            return TOO_SHORT
        pdo.take(data, now_s)
        if not pdo.synchronous and pdo.apply():
            self._applied()
        return TOO_LONG if len(data) > pdo.length else 0

    def synced(self) -> None:
        """Handle SYNC: apply RPDOs that have come, then send TPDOs that go by SYNC."""
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
        """Send TPDOs that go by events; return whether an RPDO is overdue."""
        for pdo in self._by_event:
            data = pdo.by_event(now_s)
            if data is not None:
                self._send(pdo.cob_id, data)
        return sum(pdo.overdue(now_s) for pdo in self._by_id.values()) > 0


LAST_CYCLIC = 240
"""Transmission types up to here go by SYNC; 0 by SYNC when there is something new."""

TICK_TOLERANCE_S = 1e-9


@dataclass(frozen=True, slots=True)
class Layout:
    """Compiled from 16xxh or 1Axxh.

    Attributes:
        packing: Of all mapped objects.
        keys: Where they are in the registers; dummies are not.
    """

    packing: struct.Struct
    keys: tuple[int, ...]

    @classmethod
    def of(cls, registers: Registers, index: int) -> Layout:
        """Return the objects of a mapping."""
        raw = (registers[key(index, sub)] for sub in range(1, registers[key(index)] + 1))
        entries = [mapped(entry) for entry in raw]
        codes = "".join(
            f"{bits // 8}x" if (where, bits) in DUMMIES else CODES[by_key()[where].type]
            for where, bits in entries
        )
        keys = tuple(where for where, bits in entries if (where, bits) not in DUMMIES)
        return cls(struct.Struct("<" + codes), keys)


class Rpdo:
    """Process data to the drive.

    Args:
        registers: Live.
        number: From 0.

    Attributes:
        cob_id: −1 while it does not exist.
        synchronous: It is applied at the next SYNC, else at once.
    """

    def __init__(self, registers: Registers, number: int) -> None:
        self._registers, self._index = registers, RPDO_PARAMETERS + number
        self.configure()

    def configure(self) -> None:
        """Read the parameters anew."""
        registers, index = self._registers, self._index
        self._layout = Layout.of(registers, index - RPDO_PARAMETERS + RPDO_MAPPING)
        self.cob_id = _cob_id(registers, index, self._layout)
        self.synchronous = registers[key(index, TRANSMISSION)] <= LAST_CYCLIC
        self._timeout_s = registers[key(index, EVENT_TIMER)] / 1000
        self.restart()

    def restart(self) -> None:
        """Forget RPDOs that have come."""
        self._waiting: bytes | None = None
        self._heard_s: float | None = None

    @property
    def keys(self) -> tuple[int, ...]:
        """Objects that it carries."""
        return self._layout.keys

    @property
    def length(self) -> int:
        """Bytes it must have at least."""
        return self._layout.packing.size

    def take(self, data: bytes, now_s: float) -> None:
        """It has come, long enough; `apply` writes it into the registers."""
        self._waiting, self._heard_s = data, now_s

    def apply(self) -> bool:
        """Write data that have come into the registers; return whether there were any."""
        if self._waiting is None:
            return False
        values = self._layout.packing.unpack_from(self._waiting)
        self._registers.update(zip(self._layout.keys, values, strict=True))
        self._waiting = None
        return True

    def overdue(self, now_s: float) -> bool:
        """Return, once, whether its event timer has run out since it last came."""
        if not self._timeout_s or self._heard_s is None:
            return False
        if now_s - self._heard_s <= self._timeout_s + TICK_TOLERANCE_S:
            return False
        self._heard_s = None
        return True


def _cob_id(registers: Registers, index: int, layout: Layout) -> int:
    """Identifier of a PDO that exists and carries something."""
    cob_id = registers[key(index, COB_ID)]
    return cob_id & CAN_ID if cob_id_is_valid(cob_id) and layout.keys else -1


class Tpdo:
    """Process data from the drive.

    Args:
        registers: Live.
        number: From 0.

    Attributes:
        cob_id: −1 while it does not exist.
        synchronous: It is sent with SYNC, else by events.
    """

    def __init__(self, registers: Registers, number: int) -> None:
        self._registers, self._index = registers, TPDO_PARAMETERS + number
        self.configure()

    def configure(self) -> None:
        """Read the parameters anew."""
        registers, index = self._registers, self._index
        self._layout = Layout.of(registers, index - TPDO_PARAMETERS + TPDO_MAPPING)
        self.cob_id = _cob_id(registers, index, self._layout)
        self._type = registers[key(index, TRANSMISSION)]
        self.synchronous = self._type <= LAST_CYCLIC
        self._inhibit_s = registers[key(index, INHIBIT)] / 10_000
        self._event_s = registers[key(index, EVENT_TIMER)] / 1000
        self.restart()

    def restart(self) -> None:
        """Begin to count SYNCs, and take everything for new."""
        self._syncs = 0
        self._sent: bytes | None = None
        self._sent_s = 0.0

    def with_sync(self) -> bytes | None:
        """Return the data to be sent with this SYNC."""
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
        """Return the data to be sent now: they are new, or the event timer has run out."""
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
    """In the order of their numbers."""
    return [Rpdo(registers, number) for number in range(N_PDOS)]


def all_tpdos(registers: Registers) -> list[Tpdo]:
    """In the order of their numbers."""
    return [Tpdo(registers, number) for number in range(N_PDOS)]
