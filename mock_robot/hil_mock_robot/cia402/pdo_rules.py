"""What a client may write to 1400h … 1BFFh, and in which order (CiA 301, PDO mapping procedure).

Invalidate the PDO (bit 31 of its COB-ID), set the number of mapped objects to 0, write them, set
their number, set transmission type and timers, make the PDO valid again. Out of order the answer
is 0800 0022h; the mock wants all of it outside of the NMT state operational, as many drives do.
"""

from __future__ import annotations

from hil_mock_robot.cia402 import cob_ids
from hil_mock_robot.cia402.aborts import (
    DEVICE_STATE,
    INCOMPATIBLE,
    NO_OBJECT,
    NO_SUB_INDEX,
    NOT_MAPPABLE,
    PDO_TOO_LONG,
    require,
)
from hil_mock_robot.cia402.communication_objects import (
    N_MAPPED,
    N_PDOS,
    NO_RTR,
    RPDO_PARAMETERS,
    TPDO_MAPPING,
    TPDO_PARAMETERS,
)
from hil_mock_robot.cia402.contracts import Registers, key
from hil_mock_robot.cia402.dictionary import by_key, indices
from hil_mock_robot.cia402.objects import Object

FIRST, LAST = RPDO_PARAMETERS, TPDO_MAPPING + N_PDOS - 1
MOST_BITS = 64
_TO_MAPPING = 0x200
COB_ID, TRANSMISSION, INHIBIT, EVENT_TIMER = 1, 2, 3, 5
"""Sub-indices of the parameters."""

DUMMIES = {(key(index), bits) for index, bits in enumerate((8, 16, 32, 8, 16, 32), 2)}
"""Data types (0002h to 0007h) that an RPDO may carry for others: they are passed over."""


def concerns(index: int) -> bool:
    """Whether an object lays out a PDO."""
    return FIRST <= index <= LAST


def transmits(index: int) -> bool:
    """Whether the object is one of a TPDO."""
    return index >= TPDO_PARAMETERS


def check(registers: Registers, entry: Object, value: int) -> None:
    """A client writes to one of these objects.

    Raises:
        Abort: Not this value, or not now.
    """
    parameters = entry.index & ~_TO_MAPPING
    exists = cob_ids.valid(registers[key(parameters, COB_ID)])
    if entry.index == parameters:
        _check_parameter(registers, entry, value, exists)
    else:
        _check_mapping(registers, entry, value, exists)


def mapped(raw: int) -> tuple[int, int]:
    """Key and length in bits of what an entry of 16xxh or 1Axxh names."""
    return raw >> 8, raw & 0xFF


def _check_parameter(registers: Registers, entry: Object, value: int, exists: bool) -> None:
    if entry.sub == COB_ID:
        cob_ids.check(registers[entry.key], value, NO_RTR)
        require(not cob_ids.valid(value) or _alone(registers, entry, value), INCOMPATIBLE)
    elif entry.sub == INHIBIT:
        require(not exists or value == registers[entry.key], DEVICE_STATE)


def _alone(registers: Registers, entry: Object, value: int) -> bool:
    """Whether no other PDO of this node has the identifier."""
    others = (
        registers[key(family + number, COB_ID)]
        for family in (RPDO_PARAMETERS, TPDO_PARAMETERS)
        for number in range(N_PDOS)
        if family + number != entry.index
    )
    number = value & cob_ids.CAN_ID
    return all(not cob_ids.valid(other) or other & cob_ids.CAN_ID != number for other in others)


def _check_mapping(registers: Registers, entry: Object, value: int, exists: bool) -> None:
    require(not exists, DEVICE_STATE)
    if entry.sub == 0:
        _check_count(registers, entry.index, value)
        return
    require(registers[key(entry.index)] == 0, DEVICE_STATE)
    if value:
        _check_entry(value, transmits(entry.index))


def _check_count(registers: Registers, index: int, count: int) -> None:
    require(count <= N_MAPPED, PDO_TOO_LONG)
    entries = [registers[key(index, sub)] for sub in range(1, count + 1)]
    require(all(entries), NOT_MAPPABLE)
    require(sum(mapped(raw)[1] for raw in entries) <= MOST_BITS, PDO_TOO_LONG)


def _check_entry(raw: int, transmit: bool) -> None:
    where, bits = mapped(raw)
    if (where, bits) in DUMMIES and not transmit:
        return
    require(where >> 8 in indices(), NO_OBJECT)
    target = by_key().get(where)
    if target is None:
        require(False, NO_SUB_INDEX)
        return
    allowed = target.readable if transmit else target.writable
    require(target.mappable and allowed, NOT_MAPPABLE)
    require(bits == target.bits, INCOMPATIBLE)
