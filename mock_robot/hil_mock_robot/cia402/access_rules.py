"""Rules for the SDO access of a client to the objects of a mock drive.

The rules follow CiA 301. The rules concern the existence of an object, access, length and range of
its value, the device state, COB-IDs, and the order in which a PDO is configured. A PDO is
configured in this order: invalidate the PDO (bit 31 of its COB-ID), set the number of mapped
objects to 0, write the mapped objects, set their number, make the PDO valid again. Writes to the
mapping or inhibit time of a valid PDO are refused with 0800 0022h. Writes of a mapping entry are
refused with the same code while the number of mapped objects is not 0. `MockNode` refuses all
writes to PDO objects in the NMT state operational, as many drives do.
"""

from __future__ import annotations

from fractions import Fraction

from canopen import SdoAbortedError

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.dictionary import (
    CODES,
    N_CONSUMED,
    N_MAPPED,
    N_PDOS,
    NOT_VALID,
    RPDO_PARAMETERS,
    TPDO_MAPPING,
    TPDO_PARAMETERS,
    Object,
    by_key,
    indices,
    real,
)
from hil_mock_robot.cia402.keys import Registers, key

WRITE_ONLY = 0x0601_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
PDO_TOO_LONG = 0x0604_0042
INCOMPATIBLE = 0x0604_0043
WRONG_LENGTH = 0x0607_0010
NO_SUB_INDEX = 0x0609_0011
OUT_OF_RANGE = 0x0609_0030
DEVICE_STATE = 0x0800_0022
NO_DATA = 0x0800_0024
"""Abort codes of SDO transfers (CiA 301)."""

ERROR_FIELD, EMERGENCY_COB_ID, CONSUMERS = 0x1003, 0x1014, 0x1016
PERIOD_KEYS = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX, keys.CYCLE_PERIOD)
LONGEST_MS = 1000

OPERATION_ENABLED = 1 << 2
"""Bit of the statusword that is set in operation enabled, quick stop and fault reaction."""

Abort = SdoAbortedError
"""Exception with an SDO abort code, with which the SDO server answers the client."""


def entry_of(index: int, sub: int) -> Object:
    """Return the object with an index and a sub-index.

    Raises:
        Abort: The drive has no object with this index and sub-index.
    """
    entry = by_key().get(key(index, sub))
    if entry is None:
        raise Abort(NO_SUB_INDEX if index in indices() else NO_OBJECT)
    return entry


def read_object(registers: Registers, entry: Object, *, by_client: bool) -> bytes:
    """Return the data of an object that is not of type `domain`.

    Raises:
        Abort: The object is not readable.
    """
    require(entry.readable or not by_client, WRITE_ONLY)
    if entry.index == ERROR_FIELD and by_client:
        require(entry.sub <= registers[key(ERROR_FIELD)], NO_DATA)
    if entry.type == "text":
        return str(entry.default).encode("ascii")
    return entry.packing.pack(registers[entry.key])


def decoded_value(registers: Registers, entry: Object, data: bytes, *, by_client: bool) -> int:
    """Decode the data written to an object, after checking that the write is allowed.

    Raises:
        Abort: The object is not writable, the value is invalid, or the write is not allowed in the
            present state of the drive.
    """
    require(entry.writable or not by_client, READ_ONLY)
    require(entry.type in CODES and len(data) == entry.packing.size, WRONG_LENGTH)
    value: int = entry.packing.unpack(data)[0]
    _check_rules(registers, entry, value)
    require(entry.allows(real(value) if entry.type == "f32" else value), OUT_OF_RANGE)
    working = registers[keys.STATUSWORD] & OPERATION_ENABLED
    require(not (entry.locked and working), DEVICE_STATE)
    return value


def _check_rules(registers: Registers, entry: Object, value: int) -> None:
    if is_pdo_object(entry.index):
        check_pdo(registers, entry, value)
    elif entry.index == EMERGENCY_COB_ID:
        check_cob_id(registers[entry.key], value)
    elif entry.key in PERIOD_KEYS:
        _check_period(registers, entry, value)
    elif entry.index == CONSUMERS:
        check_consumer(registers, entry.sub, value)


def _check_period(registers: Registers, entry: Object, value: int) -> None:
    """Raise `Abort` unless the SYNC period is a multiple of the drives' 1 ms step, up to 1 s."""
    if entry.key == keys.CYCLE_PERIOD:
        millis = Fraction(value, 1000)
    else:
        pair = {where: registers[where] for where in PERIOD_KEYS} | {entry.key: value}
        require(entry.allows(value), OUT_OF_RANGE)
        millis = pair[PERIOD_KEYS[0]] * Fraction(10) ** (pair[PERIOD_KEYS[1]] + 3)
    require(millis.denominator == 1 and millis <= LONGEST_MS, OUT_OF_RANGE)


def watched(raw: int) -> tuple[int, float]:
    """Return node id and time-out [s] in an entry of 1016h; 0 s if no node is monitored."""
    node, milliseconds = raw >> 16 & 0xFF, raw & 0xFFFF
    return node, milliseconds / 1000 if 0 < node < 128 else 0.0


def check_consumer(registers: Registers, sub: int, value: int) -> None:
    """Check a value that a client writes to an entry of 1016h.

    Raises:
        Abort: The same node is already monitored by another entry.
    """
    others = (registers[key(CONSUMERS, n)] for n in range(1, N_CONSUMED + 1) if n != sub)
    nodes = {watched(raw)[0] for raw in others if watched(raw)[1]}
    require(not watched(value)[1] or watched(value)[0] not in nodes, INCOMPATIBLE)


FIRST_PDO_OBJECT, LAST_PDO_OBJECT = RPDO_PARAMETERS, TPDO_MAPPING + N_PDOS - 1
MOST_BITS = 64

CAN_ID = 0x7FF
COB_ID, TRANSMISSION, INHIBIT, EVENT_TIMER = 1, 2, 3, 5
"""Sub-indices of the PDO communication parameters."""

DUMMIES = {(key(index), bits) for index, bits in enumerate((8, 16, 32, 8, 16, 32), 2)}
"""Data types (0002h to 0007h) that an RPDO can contain as placeholders without effect."""


def is_pdo_object(index: int) -> bool:
    """Return whether an object is part of a PDO configuration."""
    return FIRST_PDO_OBJECT <= index <= LAST_PDO_OBJECT


def transmits(index: int) -> bool:
    """Return whether an object is part of a TPDO configuration."""
    return index >= TPDO_PARAMETERS


_TO_MAPPING = 0x200


def check_pdo(registers: Registers, entry: Object, value: int) -> None:
    """Check a value that a client writes to a PDO object.

    Raises:
        Abort: The value is invalid, or the write is not allowed in the present state of the PDO.
    """
    parameters = entry.index & ~_TO_MAPPING
    exists = cob_id_is_valid(registers[key(parameters, COB_ID)])
    if entry.index == parameters:
        _check_parameter(registers, entry, value, exists)
    else:
        _check_mapping(registers, entry, value, exists)


def _check_parameter(registers: Registers, entry: Object, value: int, exists: bool) -> None:
    if entry.sub == COB_ID:
        check_cob_id(registers[entry.key], value)
        require(
            not cob_id_is_valid(value) or _cob_id_is_free(registers, entry, value), INCOMPATIBLE
        )
    elif entry.sub == INHIBIT:
        require(not exists or value == registers[entry.key], DEVICE_STATE)


def _cob_id_is_free(registers: Registers, entry: Object, value: int) -> bool:
    """Return whether no other PDO of the node uses an identifier."""
    others = (
        registers[key(family + number, COB_ID)]
        for family in (RPDO_PARAMETERS, TPDO_PARAMETERS)
        for number in range(N_PDOS)
        if family + number != entry.index
    )
    number = value & CAN_ID
    return all(not cob_id_is_valid(other) or other & CAN_ID != number for other in others)


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
        raise Abort(NO_SUB_INDEX)
    allowed = target.readable if transmit else target.writable
    require(target.mappable and allowed, NOT_MAPPABLE)
    require(bits == target.bits, INCOMPATIBLE)


def mapped(raw: int) -> tuple[int, int]:
    """Return the key and the length [bits] of the object in a mapping entry (16xxh or 1Axxh)."""
    return raw >> 8, raw & 0xFF


RESTRICTED = (
    (0x000, 0x080), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF),
)  # fmt: skip
"""First and last CAN identifier of each range reserved for NMT, SYNC, SDO and heartbeat."""

EXTENDED_PART = 0x3FFF_F800
"""Bits of a COB-ID that only a 29-bit identifier uses, including the bit that marks it."""


def cob_id_is_valid(cob_id: int) -> bool:
    """Return whether the communication object with a COB-ID is in use."""
    return not cob_id & NOT_VALID


def check_cob_id(old: int, new: int) -> None:
    """Check a COB-ID that a client writes in place of the old COB-ID.

    Raises:
        Abort: The new COB-ID is invalid, or the identifier changes while the old COB-ID is in use.
    """
    require(not new & EXTENDED_PART, OUT_OF_RANGE)
    number = new & CAN_ID
    require(not any(first <= number <= last for first, last in RESTRICTED), OUT_OF_RANGE)
    in_use = cob_id_is_valid(old) and cob_id_is_valid(new)
    require(not in_use or old & CAN_ID == number, DEVICE_STATE)


def require(condition: bool, code: int) -> None:
    """Raise `Abort` with an abort code unless a condition is true."""
    if not condition:
        raise Abort(code)
