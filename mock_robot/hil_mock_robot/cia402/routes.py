"""Which drives take notice of a frame: most are for one of them."""

from __future__ import annotations

from collections.abc import Sequence

from hil_mock_robot.cia402.communication_objects import N_PDOS, NOT_VALID, RPDO_PARAMETERS
from hil_mock_robot.cia402.contracts import key
from hil_mock_robot.cia402.pdo_rules import COB_ID
from hil_mock_robot.cia402.unit import Unit

PROCESS_DATA = range(0x181, 0x580)
SDO = 0x600
SDO_REQUESTS = range(SDO + 1, SDO + 0x80)
CAN_ID = 0x7FF


class Routes:
    """Looks up who hears a frame, and remembers it until a COB-ID changes.

    Args:
        units: All drives.
    """

    def __init__(self, units: Sequence[Unit]) -> None:
        self._units = tuple(units)
        self._known: dict[int, tuple[Unit, ...]] = {}

    def to(self, can_id: int) -> tuple[Unit, ...]:
        """The drives that hear frames of this identifier."""
        found = self._known.get(can_id)
        if found is None:
            found = self._known[can_id] = self._look(can_id)
        return found

    def forget(self) -> None:
        """Parameters of PDOs have changed."""
        self._known.clear()

    def _look(self, can_id: int) -> tuple[Unit, ...]:
        if can_id in PROCESS_DATA:
            return tuple(unit for unit in self._units if can_id in _received(unit))
        if can_id in SDO_REQUESTS:
            return tuple(unit for unit in self._units if SDO + unit.node_id == can_id)
        return self._units


def _received(unit: Unit) -> set[int]:
    cob_ids = (unit.registers[key(RPDO_PARAMETERS + i, COB_ID)] for i in range(N_PDOS))
    return {cob_id & CAN_ID for cob_id in cob_ids if not cob_id & NOT_VALID}


def changed_by(where: int) -> bool:
    """Whether writing the object of this key changes routes."""
    return RPDO_PARAMETERS <= where >> 8 < RPDO_PARAMETERS + N_PDOS
