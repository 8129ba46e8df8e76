"""One drive on its line: the node, the power stage behind it, and what is between them."""

from __future__ import annotations

from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Joint
from hil_mock_robot.cia402.contracts import Registers, Send
from hil_mock_robot.cia402.drive import Drive
from hil_mock_robot.cia402.hooks import Hooks
from hil_mock_robot.cia402.line import Line
from hil_mock_robot.cia402.nmt import RESET_NODE, State
from hil_mock_robot.cia402.node import MockNode

Told = Callable[[int, str, int], None]
"""Axis from 0, what happened there (`emergency`, `nmt`, `booted`, `connection_lost`), a code."""

NMT = 0x000
PERIOD = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX, keys.CYCLE_PERIOD)


class Unit:
    """A drive with everything that belongs to it.

    Args:
        number: From 0.
        node_id: On the bus.
        registers: As after power-on.
        joint: What it turns.
        put: Puts a frame on the bus.
        told: Called with what happens.
        written: Called with axis and key of every object that a client has written.

    Attributes:
        number, node_id, registers: As given.
        line, node, drive: Its parts.
        follows_sync: Whether it takes notice of SYNC.
    """

    def __init__(
        self,
        number: int,
        node_id: int,
        registers: Registers,
        joint: Joint,
        put: Send,
        told: Told,
        written: Callable[[int, int], None],
    ) -> None:
        self.number, self.node_id, self.registers = number, node_id, registers
        self.follows_sync = True
        self._operational = False
        self._told, self._on_written = told, written
        self.line = Line(node_id, put)
        hooks = Hooks(
            applied=lambda: self.drive.obey(),
            written=self._written,
            resetting=lambda _: self.drive.connection.taken_off(),
            nmt_changed=self._nmt_changed,
            booted=self._booted,
            connection_lost=self._connection_lost,
        )
        self.node = MockNode(node_id, registers, self.line.send, hooks)
        self.drive = Drive(registers, joint, self._emergency)

    @property
    def operational(self) -> bool:
        """Whether it exchanges process data."""
        return self._operational

    @property
    def synced(self) -> bool:
        """Whether a SYNC reaches it."""
        return self.follows_sync and not self.line.cuts

    def bus_off(self) -> None:
        """Its CAN controller has given up: nothing passes, and the drive knows."""
        self.line.cuts.add("bus_off")
        self.line.look()
        self.node.bus_off()

    def recover(self) -> None:
        """It is back on the bus."""
        if "bus_off" in self.line.cuts:
            self.line.cuts.discard("bus_off")
            self.line.look()
            self.node.bus_back()

    def power_off(self) -> None:
        """Nothing works any more, the brake is on."""
        self.line.cuts.add("power")
        self.line.look()
        self.drive.reset()

    def power_on(self) -> None:
        """It starts anew, with nothing of what was set."""
        self.line.cuts.discard("power")
        self.line.look()
        self.node.heard(NMT, bytes([RESET_NODE, self.node_id]))

    def _written(self, key: int, value: int) -> None:
        self.drive.written(key)
        if key == keys.SIMULATED_ERROR:
            self.drive.fault(value)
        self._on_written(self.number, key)

    def _nmt_changed(self, state: int) -> None:
        left, self._operational = self._operational, state == State.OPERATIONAL
        self._told(self.number, "nmt", state)
        if left or state == State.STOPPED:
            self.drive.connection.taken_off()

    def _booted(self, application: bool) -> None:
        self._operational = False
        if application:
            self.drive.restart()
        self._told(self.number, "booted", int(application))

    def _connection_lost(self, code: int) -> None:
        self._told(self.number, "connection_lost", code)
        self.drive.connection.lost(code)

    def _emergency(self, code: int, register: int) -> None:
        self._told(self.number, "emergency", code)
        self.node.emergency(code, register)
