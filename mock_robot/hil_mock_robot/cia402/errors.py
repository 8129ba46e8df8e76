"""Errors of one node: EMCY messages, error register (1001h), history (1003h), last one (603Fh)."""

from __future__ import annotations

import struct
from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.communication_objects import HISTORY
from hil_mock_robot.cia402.contracts import Registers, key

FIELD = 0x1003
MESSAGE = struct.Struct("<HB5s")

GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, PROFILE, MAKER = (
    1 << bit for bit in (0, 1, 2, 3, 4, 5, 7)
)
"""Bits of the error register."""

_GROUPS = {
    0x2: CURRENT, 0x3: VOLTAGE, 0x4: TEMPERATURE, 0x7: PROFILE, 0x8: PROFILE, 0xF: MAKER,
}  # fmt: skip
_COMMUNICATION = (0x81, 0x82)


def bits_of(code: int) -> int:
    """What an error sets in the error register (CiA 301); 7xxxh and 83xxh on are CiA 402's."""
    if code >> 8 in _COMMUNICATION:
        return GENERIC | COMMUNICATION
    return GENERIC | _GROUPS.get(code >> 12, 0)


class Errors:
    """What is wrong, and what was.

    Args:
        registers: Live.
        send: Puts the eight bytes of an EMCY message on the bus, where that is allowed.
    """

    def __init__(self, registers: Registers, send: Callable[[bytes], None]) -> None:
        self._registers, self._send = registers, send
        self._active: dict[int, int] = {}

    @property
    def active(self) -> tuple[int, ...]:
        """Codes of what is wrong, in the order in which it came."""
        return tuple(self._active)

    def report(self, code: int, register: int | None = None, data: bytes = b"") -> None:
        """An error has come; one that is there already is not told again.

        Args:
            code: Error code.
            register: What it sets in 1001h, by default what its code stands for.
            data: Up to five bytes of the maker's.
        """
        if code in self._active:
            return
        self._active[code] = bits_of(code) if register is None else register | GENERIC
        self._remember(code)
        self._registers[keys.ERROR_CODE] = code
        self._tell(code, data)

    def recovered(self, code: int | None = None) -> None:
        """That error is gone, or all of them are."""
        if code is None:
            gone = bool(self._active)
            self._active.clear()
        else:
            gone = self._active.pop(code, None) is not None
        if gone:
            self._tell(0, b"")

    def told_late(self, code: int) -> None:
        """An error that came while nobody could be told: it is there, or it was."""
        if code in self._active:
            self._tell(code, b"")
        else:
            self.report(code)
            self.recovered(code)

    def forget(self) -> None:
        """The node was switched off and on."""
        self._active.clear()
        self._registers[keys.ERROR_REGISTER] = self._registers[keys.ERROR_CODE] = 0
        self.clear_history()

    def clear_history(self) -> None:
        """Nothing has ever been wrong."""
        for sub in range(HISTORY + 1):
            self._registers[key(FIELD, sub)] = 0

    def _remember(self, code: int) -> None:
        registers = self._registers
        for sub in range(HISTORY, 1, -1):
            registers[key(FIELD, sub)] = registers[key(FIELD, sub - 1)]
        registers[key(FIELD, 1)] = code
        registers[key(FIELD)] = min(HISTORY, registers[key(FIELD)] + 1)

    def _tell(self, code: int, data: bytes) -> None:
        register = 0
        for bits in self._active.values():
            register |= bits
        self._registers[keys.ERROR_REGISTER] = register
        self._send(MESSAGE.pack(code, register, data))
