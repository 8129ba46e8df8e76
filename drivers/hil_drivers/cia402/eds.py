"""EDS files: what a maker says of his drive's object dictionary, asked before the drive is."""

from __future__ import annotations

from typing import Any

from hil.core import SpecError
from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.objects import Entry


def dictionary_of(path: str, node: int) -> Any:
    """The `canopen.ObjectDictionary` in an EDS or DCF file.

    Args:
        path: Of the file.
        node: Node id; COB-IDs in the file may depend on it.

    Raises:
        SpecError: It cannot be read.
    """
    import canopen

    try:
        return canopen.import_od(path, node)
    except Exception as error:  # an importer of whatever the file may hold
        raise SpecError(
            f"{path} is no EDS file that can be read: {error}", hint="take the maker's own"
        ) from error


def require_mappable(dictionary: Any, mapping: Mapping, where: str) -> None:
    """Refuse a mapping of objects that the file does not have, or not for PDOs.

    Args:
        dictionary: What `dictionary_of` gave.
        mapping: Of every axis.
        where: Which file and which axis, for messages.

    Raises:
        SpecError: One line for each object that cannot be.
    """
    wrong = [
        f"{where}: {entry} {why}"
        for pdo in mapping.pdos
        for entry in pdo.entries
        if (why := _why_not(dictionary, entry, received=pdo in mapping.rpdos))
    ]
    if wrong:
        raise SpecError(
            "\n".join(wrong),
            hint=f"mapping {mapping.name} needs them: choose another one, or the drive's own EDS",
        )


def _why_not(dictionary: Any, entry: Entry, *, received: bool) -> str:
    variable = dictionary.get_variable(entry.index, entry.sub)
    if variable is None:
        return "is not in it"
    if not variable.pdo_mappable:
        return "cannot be mapped into a PDO"
    if len(variable) != entry.bits:
        return f"has {len(variable)} bits there, {entry.bits} by CiA 402"
    if received and not variable.writable:
        return "cannot be written"
    return ""
