"""All PDOs of one node: what they do while it is operational."""

from __future__ import annotations

from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.contracts import Registers, Send
from hil_mock_robot.cia402.pdo import Rpdo, Tpdo, all_rpdos, all_tpdos

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
        """An RPDO has come; what is wrong with it (error code), 0 where nothing is.

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
        """SYNC: what has come is applied, then what goes by SYNC is sent."""
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
        """Send what goes by events; whether an RPDO is overdue."""
        for pdo in self._by_event:
            data = pdo.by_event(now_s)
            if data is not None:
                self._send(pdo.cob_id, data)
        return sum(pdo.overdue(now_s) for pdo in self._by_id.values()) > 0
