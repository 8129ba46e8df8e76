"""canopen's PdoMaps and dictionaries for the mapping that is measured, on either end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from canopen import objectdictionary
from canopen.objectdictionary import datatypes

from hil_drivers.cia402.mapping import POSITION, Pdo
from hil_drivers.cia402.objects import Entry

_TYPES = {
    "b": datatypes.INTEGER8,
    "h": datatypes.INTEGER16,
    "H": datatypes.UNSIGNED16,
    "i": datatypes.INTEGER32,
}


def lay_out(pdo_map: Any, pdo: Pdo, cob_id: Callable[[int, int], int]) -> Any:
    """Return the PDO map of a node as the driver computes it, without a drive."""
    pdo_map.clear()
    for entry in pdo.entries:
        pdo_map.add_variable(entry.index)
    pdo_map.cob_id = cob_id(pdo.number, pdo_map.pdo_node.node.id)
    pdo_map.enabled = True
    return pdo_map


def dictionary() -> Any:
    """Return the mapped objects and the records of the PDOs."""
    told: Any = objectdictionary.ObjectDictionary()  # type: ignore[no-untyped-call]
    for pdo in POSITION.pdos:
        for entry in pdo.entries:
            told.add_object(_variable(entry))
    for pdos, base in ((POSITION.rpdos, 0x1400), (POSITION.tpdos, 0x1800)):
        for pdo in pdos:
            for index in (base + pdo.number - 1, base + 0x200 + pdo.number - 1):
                told.add_object(objectdictionary.ODRecord(f"{index:04X}h", index))
    return told


def _variable(entry: Entry) -> Any:
    variable = objectdictionary.ODVariable(entry.name, entry.index, entry.sub)
    variable.data_type = _TYPES[entry.code]
    return variable
