"""The procedure by which a drive's PDOs are laid out (CiA 301), in pre-operational, read back."""

from __future__ import annotations

from hil.core import CommandRefused
from hil_drivers.cia402.aborts import NOT_THERE, NOT_TO_WRITE, Aborted
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.mapping import Mapping, Pdo, rpdo_cob_id, tpdo_cob_id
from hil_drivers.cia402.objects import Entry

NOT_VALID, NO_RTR = 1 << 31, 1 << 30
EVERY_SYNC = 1
"""Transmission type: an RPDO is applied at the next SYNC, a TPDO sampled and sent at each."""

ALL_PDOS = frozenset({1, 2, 3, 4})
"""Of the predefined connection set: those that are not ours are switched off."""

_FIXED = NOT_TO_WRITE | NOT_THERE
"""Answers of drives whose mapping is as it is."""


def lay_out(acyclic: Acyclic, axis: int, node: int, name: str, mapping: Mapping) -> None:
    """Make the PDOs of one axis as `mapping` says, and all others silent.

    Args:
        acyclic: To the drives.
        axis: From 0.
        node: Its id.
        name: For messages.
        mapping: What is wanted.

    Raises:
        CommandRefused: The drive does not take it, or reads back something else.
        RobotTimeout: It has not answered.
    """
    for received, pdos in ((True, mapping.rpdos), (False, mapping.tpdos)):
        for pdo in pdos:
            _PdoOf(acyclic, axis, node, name, pdo.number, received=received).lay_out(pdo)
        for number in ALL_PDOS - {pdo.number for pdo in pdos}:
            _PdoOf(acyclic, axis, node, name, number, received=received).silence()


class _PdoOf:
    """The objects of one PDO of one drive."""

    def __init__(
        self, acyclic: Acyclic, axis: int, node: int, name: str, number: int, *, received: bool
    ) -> None:
        self._acyclic, self._axis = acyclic, axis
        self._called = f"{name}: {'RPDO' if received else 'TPDO'}{number}"
        communication = (0x1400 if received else 0x1800) + number - 1
        self._mapped = (0x1600 if received else 0x1A00) + number - 1
        self._cob_id = Entry("PDO COB-ID", communication, 1, "I")
        self._type = Entry("PDO transmission type", communication, 2, "B")
        self._count = Entry("number of mapped objects", self._mapped, 0, "B")
        cob_id = rpdo_cob_id(number, node) if received else tpdo_cob_id(number, node)
        self._valid = cob_id if received else cob_id | NO_RTR

    def lay_out(self, pdo: Pdo) -> None:
        wanted = [entry.mapped for entry in pdo.entries]
        self._write(self._cob_id, self._valid | NOT_VALID)
        self._map(pdo, wanted)
        self._write(self._type, EVERY_SYNC)
        self._write(self._cob_id, self._valid)
        self._check(pdo, wanted)

    def silence(self) -> None:
        """Invalid, if there is such a PDO at all."""
        try:
            now = self._read(self._cob_id)
        except Aborted as error:
            if error.code in NOT_THERE:
                return
            raise
        if not now & NOT_VALID:
            self._write(self._cob_id, now | NOT_VALID)

    def _map(self, pdo: Pdo, wanted: list[int]) -> None:
        try:
            self._write(self._count, 0)
        except Aborted as error:
            if error.code in _FIXED and self._mapping() == wanted:
                return
            raise
        for sub, entry in enumerate(pdo.entries, start=1):
            self._place(sub, entry)
        self._write(self._count, len(wanted))

    def _place(self, sub: int, entry: Entry) -> None:
        try:
            self._acyclic.download(self._axis, self._slot(sub), entry.mapped)
        except Aborted as error:
            raise Aborted(
                f"{self._called} cannot carry {entry}",
                error.code,
                hint="choose another `mapping` in the station, or map it with the maker's tool",
            ) from error

    def _check(self, pdo: Pdo, wanted: list[int]) -> None:
        mapped = self._mapping()
        if mapped != wanted:
            told = ", ".join(f"{each:08X}h" for each in mapped) or "nothing"
            asked = ", ".join(str(entry) for entry in pdo.entries)
            raise CommandRefused(
                f"{self._called} carries {told} after it was given {asked}", hint=_SAME_AGAIN
            )
        for entry, value in ((self._type, EVERY_SYNC), (self._cob_id, self._valid)):
            now = self._read(entry)
            # Bit 30 of a COB-ID (no remote frames) is not kept by all drives, and not needed.
            if now | NO_RTR != value | NO_RTR:
                raise CommandRefused(
                    f"{self._called}: {entry} reads {now:X}h after {value:X}h was written",
                    hint=_SAME_AGAIN,
                )

    def _mapping(self) -> list[int]:
        count = self._read(self._count)
        return [self._read(self._slot(sub)) for sub in range(1, count + 1)]

    def _slot(self, sub: int) -> Entry:
        return Entry("mapped object", self._mapped, sub, "I")

    def _read(self, entry: Entry) -> int:
        return self._acyclic.upload(self._axis, entry)

    def _write(self, entry: Entry, value: int) -> None:
        self._acyclic.download(self._axis, entry, value)


_SAME_AGAIN = "switch the drive off and on; if it says the same again, its mapping is fixed"
