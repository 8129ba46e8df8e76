"""One drive as a CANopen node: SDO, NMT, EMCY, heartbeat and PDOs on its live registers."""

from __future__ import annotations

import canopen

from hil_mock_robot.cia402.contracts import Registers, Send
from hil_mock_robot.cia402.hooks import Hooks


class MockNode(canopen.LocalNode):
    """Implements `contracts.Node`.

    Args:
        node_id: 1 to 127.
        registers: What `dictionary.registers_of` returned; live, shared with the drive.
        send: Puts a frame on the bus.
        hooks: What the drive behind it wants to be told.
        boot_s: Device time that a reset takes, in which it is deaf.

    Attributes:
        node_id, registers, hooks: As given.
    """

    def __init__(
        self,
        node_id: int,
        registers: Registers,
        send: Send,
        hooks: Hooks | None = None,
        boot_s: float = 0.0,
    ) -> None:
        raise NotImplementedError

    def boot(self) -> None:
        """Power on: boot-up message, then pre-operational; nothing is heard before."""

    def heard(self, can_id: int, data: bytes) -> None:
        """A frame was on the bus (not one of its own); SYNC comes separately."""

    def synced(self) -> None:
        """A SYNC was on the bus: RPDOs that came before it are applied, TPDOs are sent."""

    def ticked(self, device_s: float) -> None:
        """Time has passed: heartbeats, event timers, consumers' watch."""

    def emergency(self, code: int, data: bytes = b"") -> None:
        """Report an error: EMCY, 603Fh, 1001h, 1003h; an error that is there already is not new."""

    def recovered(self, code: int | None = None) -> None:
        """That error is gone, or all are: EMCY 0000h when none is left."""
