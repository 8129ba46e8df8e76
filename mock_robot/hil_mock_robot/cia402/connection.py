"""What a drive does when its master has no say any more (6007h)."""

from __future__ import annotations

from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.contracts import Registers
from hil_mock_robot.cia402.power import PowerStage
from hil_mock_robot.cia402.states import Command
from hil_mock_robot.cia402.stopping import option_of

TAKEN_OFF = 0x8100
"""Error code: communication; the NMT master has taken an enabled drive out of operation."""

FAULT = 1
COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}
"""6007h; 0 is nothing."""


class Connection:
    """The reaction to a connection that is lost.

    Args:
        registers: Live.
        power: What it acts on.
        fault: Lets the drive fail with an error code.
    """

    def __init__(
        self, registers: Registers, power: PowerStage, fault: Callable[[int], None]
    ) -> None:
        self._registers, self._power, self._fault = registers, power, fault

    def lost(self, code: int) -> None:
        """An error of the connection: a heartbeat that is overdue, bus off, RPDOs that stay away.

        The controlword that the master has left behind counts no more until it is another one.
        """
        option = option_of(self._registers, keys.ABORT_CONNECTION_OPTION)
        if option == FAULT:
            self._fault(code)
        elif option in COMMANDS:
            self._power.overrule(COMMANDS[option])

    def taken_off(self) -> None:
        """The NMT state operational is left, or a reset is to come: the same where it has power."""
        if self._power.powered:
            self.lost(TAKEN_OFF)
