"""Reading and writing objects by SDO: existence, access, length, range, order, device state."""

from __future__ import annotations

from fractions import Fraction

from hil_mock_robot.cia402 import cob_ids, heartbeat, keys, pdo_rules
from hil_mock_robot.cia402.aborts import (
    DEVICE_STATE,
    NO_DATA,
    NO_OBJECT,
    NO_SUB_INDEX,
    OUT_OF_RANGE,
    READ_ONLY,
    WRITE_ONLY,
    WRONG_LENGTH,
    Abort,
    require,
)
from hil_mock_robot.cia402.contracts import Registers, key
from hil_mock_robot.cia402.dictionary import by_key, indices
from hil_mock_robot.cia402.objects import CODES, Object, real

ERROR_FIELD, EMERGENCY_COB_ID = 0x1003, 0x1014
RHYTHM = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX, keys.CYCLE_PERIOD)
LONGEST_MS = 1000
OPERATION_ENABLED = 1 << 2
"""Bit of the statusword that is set while the drive works, stops quickly or reacts to a fault."""


def entry_of(index: int, sub: int) -> Object:
    """The variable at that place.

    Raises:
        Abort: There is none.
    """
    entry = by_key().get(key(index, sub))
    if entry is None:
        raise Abort(NO_SUB_INDEX if index in indices() else NO_OBJECT)
    return entry


def read(registers: Registers, entry: Object, *, by_client: bool) -> bytes:
    """An object's data, all but `domain`.

    Raises:
        Abort: A client may not read it.
    """
    require(entry.readable or not by_client, WRITE_ONLY)
    if entry.index == ERROR_FIELD and by_client:
        require(entry.sub <= registers[key(ERROR_FIELD)], NO_DATA)
    if entry.type == "text":
        return str(entry.default).encode("ascii")
    return entry.packing.pack(registers[entry.key])


def decoded(registers: Registers, entry: Object, data: bytes, *, by_client: bool) -> int:
    """What an object's register becomes when that data is written to it.

    Raises:
        Abort: It may not be written, not with this, or not now.
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
    if pdo_rules.concerns(entry.index):
        pdo_rules.check(registers, entry, value)
    elif entry.index == EMERGENCY_COB_ID:
        cob_ids.check(registers[entry.key], value)
    elif entry.key in RHYTHM:
        _check_rhythm(registers, entry, value)
    elif entry.index == heartbeat.CONSUMERS:
        heartbeat.check_consumer(registers, entry.sub, value)


def _check_rhythm(registers: Registers, entry: Object, value: int) -> None:
    """SYNC comes with steps of the drives, which are of 1 ms, and once a second at least."""
    if entry.key == keys.CYCLE_PERIOD:
        millis = Fraction(value, 1000)
    else:
        pair = {where: registers[where] for where in RHYTHM} | {entry.key: value}
        require(entry.allows(value), OUT_OF_RANGE)
        millis = pair[RHYTHM[0]] * Fraction(10) ** (pair[RHYTHM[1]] + 3)
    require(millis.denominator == 1 and millis <= LONGEST_MS, OUT_OF_RANGE)
