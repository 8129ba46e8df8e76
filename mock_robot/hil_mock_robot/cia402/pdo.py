"""Process data: compiled layouts, RPDOs into the registers, TPDOs out of them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from hil_mock_robot.cia402 import cob_ids
from hil_mock_robot.cia402.communication_objects import (
    N_PDOS,
    RPDO_MAPPING,
    RPDO_PARAMETERS,
    TPDO_MAPPING,
    TPDO_PARAMETERS,
)
from hil_mock_robot.cia402.contracts import Registers, key
from hil_mock_robot.cia402.dictionary import by_key
from hil_mock_robot.cia402.objects import CODES
from hil_mock_robot.cia402.pdo_rules import (
    COB_ID,
    DUMMIES,
    EVENT_TIMER,
    INHIBIT,
    TRANSMISSION,
    mapped,
)

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
        """What that mapping says."""
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
        """Forget what has come."""
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
        """Write what has come into the registers; whether there was something."""
        if self._waiting is None:
            return False
        values = self._layout.packing.unpack_from(self._waiting)
        self._registers.update(zip(self._layout.keys, values, strict=True))
        self._waiting = None
        return True

    def overdue(self, now_s: float) -> bool:
        """Whether its event timer has run out since it last came; told once."""
        if not self._timeout_s or self._heard_s is None:
            return False
        if now_s - self._heard_s <= self._timeout_s + TICK_TOLERANCE_S:
            return False
        self._heard_s = None
        return True


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
        """What is to be sent with this SYNC."""
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
        """What is to be sent now because something is new, or the event timer has run out."""
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


def _cob_id(registers: Registers, index: int, layout: Layout) -> int:
    """Identifier of a PDO that exists and carries something."""
    cob_id = registers[key(index, COB_ID)]
    return cob_id & cob_ids.CAN_ID if cob_ids.valid(cob_id) and layout.keys else -1


def all_rpdos(registers: Registers) -> list[Rpdo]:
    """In the order of their numbers."""
    return [Rpdo(registers, number) for number in range(N_PDOS)]


def all_tpdos(registers: Registers) -> list[Tpdo]:
    """In the order of their numbers."""
    return [Tpdo(registers, number) for number in range(N_PDOS)]
