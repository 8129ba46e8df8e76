"""The object dictionary as other CANopen tools take it: `canopen` objects, and an EDS file."""

from __future__ import annotations

import io
import warnings
from typing import Any

import canopen
from canopen.objectdictionary import (
    ODArray,
    ODRecord,
    ODVariable,
    datatypes,
)

from hil_mock_robot.cia402.communication_objects import N_PDOS
from hil_mock_robot.cia402.contracts import Registers
from hil_mock_robot.cia402.dictionary import TABLE
from hil_mock_robot.cia402.objects import CODES, Group, Object, real

DATA_TYPES = {
    "i8": datatypes.INTEGER8,
    "u8": datatypes.UNSIGNED8,
    "i16": datatypes.INTEGER16,
    "u16": datatypes.UNSIGNED16,
    "i32": datatypes.INTEGER32,
    "u32": datatypes.UNSIGNED32,
    "f32": datatypes.REAL32,
    "text": datatypes.VISIBLE_STRING,
    "domain": datatypes.DOMAIN,
}

BIT_RATES = (125_000, 250_000, 500_000, 1_000_000)
_ASCII = str.maketrans({"‰": "1/1000", "µ": "u", "·": "*", "²": "^2", "°": "deg "})
_DATES = {
    "CreationDate": "01-01-2026", "CreationTime": "12:00AM",
    "ModificationDate": "01-01-2026", "ModificationTime": "12:00AM", "EDSVersion": "4.0",
}  # fmt: skip
"""The same dictionary is the same file, whenever it is written."""


def object_dictionary(node_id: int, registers: Registers) -> canopen.ObjectDictionary:
    """The dictionary of one drive; defaults are what is in the registers now.

    Args:
        node_id: 1 to 127.
        registers: As `registers_of` returned them, COB-IDs without the node's id.
    """
    dictionary: canopen.ObjectDictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = node_id
    device = dictionary.device_information
    device.vendor_name, device.vendor_number = "none", 0
    device.product_name, device.product_number = "HIL mock drive", 0x402
    device.revision_number = 0x0001_0000
    device.simple_boot_up_slave = True
    vars(device).update(nr_of_RXPDO=N_PDOS, nr_of_TXPDO=N_PDOS)
    device.allowed_baudrates = set(BIT_RATES)
    for part in TABLE:
        dictionary.add_object(_group(part, node_id, registers) if isinstance(part, Group)
                              else _variable(part, node_id, registers))  # fmt: skip
    return dictionary


def eds_of(dictionary: canopen.ObjectDictionary) -> bytes:
    """An EDS file in ASCII."""
    from canopen.objectdictionary.eds import export_eds

    text = io.StringIO()
    with warnings.catch_warnings():
        # The library asks for the time in a way that Python 3.12 and later warn about.
        warnings.simplefilter("ignore", DeprecationWarning)
        export_eds(dictionary, text, dict(_DATES))  # type: ignore[no-untyped-call]
    return text.getvalue().encode("ascii")


def _group(part: Group, node_id: int, registers: Registers) -> ODArray | ODRecord:
    made = (ODArray if part.array else ODRecord)(part.name, part.index)
    for member in part.members:
        made.add_member(_variable(member, node_id, registers))
    return made


def _variable(entry: Object, node_id: int, registers: Registers) -> ODVariable:
    made = ODVariable(entry.name, entry.index, entry.sub)
    made.data_type, made.access_type = DATA_TYPES[entry.type], entry.access
    made.pdo_mappable, made.relative = entry.mappable, entry.node_relative
    made.min, made.max = entry.low, entry.high
    made.unit = entry.unit.translate(_ASCII)
    made.description = entry.note.translate(_ASCII).replace(";", ",")
    made.default = _default(entry, node_id, registers)
    if entry.type in CODES:
        vars(made)["default_raw"] = _written(entry, registers[entry.key])
    return made


def _default(entry: Object, node_id: int, registers: Registers) -> Any:
    if entry.type not in CODES:
        return entry.default if entry.type == "text" else None
    raw = registers[entry.key] + node_id * entry.node_relative
    return real(raw) if entry.type == "f32" else raw


def _written(entry: Object, raw: int) -> str:
    """As in an EDS; the library's own spelling of negative numbers cannot be read back."""
    if entry.node_relative:
        return f"$NODEID+0x{raw:X}"
    if entry.type == "f32":
        return str(real(raw))
    return f"0x{raw:X}" if raw >= 0 else str(raw)
