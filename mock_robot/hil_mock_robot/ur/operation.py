"""The word in which a program tells how far its asynchronous operation is."""

from __future__ import annotations

from hil_mock_robot.ur.registers import Registers

WORD, LARGEST_COUNT, MOST_PROGRESS = 2, 127, 0x7FFF
RUNNING = 1 << 15


class Operation:
    """Bits 0–14 progress, 15 running, 16–23 count of changes, 24–30 number of the operation.

    Args:
        registers: Where it is told: integer 2.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._changes = self._number = 0
        self.finish()

    def start(self) -> None:
        """Another operation begins."""
        self.progress(0)

    def progress(self, value: int) -> None:
        """It has come to `value`; 0 counts as another operation, as in the script."""
        if value == 0:
            self._number = (self._number + 1) % (LARGEST_COUNT + 1)
        self._tell(RUNNING + min(value, MOST_PROGRESS))

    def finish(self) -> None:
        """None is under way."""
        self._tell(0)

    def _tell(self, rest: int) -> None:
        self._changes = (self._changes + 1) % (LARGEST_COUNT + 1)
        self._registers.put_integer(WORD, self._number << 24 | self._changes << 16 | rest)
