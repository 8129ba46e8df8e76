"""Moves one axis on a CiA 402 drive by `canopen`, in profile position mode."""

from __future__ import annotations

import time
from collections.abc import Callable

import canopen

CONTROLWORD, STATUSWORD, ERROR_CODE = 0x6040, 0x6041, 0x603F
MODE, POSITION, TARGET = 0x6060, 0x6064, 0x607A
PROFILE_POSITION = 1

SHUTDOWN, SWITCH_ON, ENABLE, GO, FAULT_RESET = 0x06, 0x07, 0x0F, 0x3F, 0x80
STATE_MASK, ENABLED = 0x6F, 0x27
FAULT_MASK, FAULT, FAULT_BIT = 0x4F, 0x08, 0x08
TAKEN, REACHED = 0x1000, 0x400
WITHIN_S = 30.0


class DriveFault(Exception):
    """The drive has failed; `enable` resets what can be reset.

    Attributes:
        code: Its error code, object 603Fh.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"the drive reports {code:04X}h")
        self.code = code


class Axis:
    """One drive on a CANopen network.

    Args:
        network: Connected.
        node: Its node id.
    """

    def __init__(self, network: canopen.Network, node: int) -> None:
        self._sdo = network.add_node(node, upload_eds=True).sdo

    def position(self) -> int:
        """Where the axis is [increments]."""
        return int(self._sdo[POSITION].raw)

    def enable(self) -> None:
        """Reset what has failed, switch the drive on, in profile position mode.

        Raises:
            DriveFault: Its fault cannot be reset.
        """
        if self._sdo[STATUSWORD].raw & FAULT_BIT:
            # One that has failed while it moved comes to rest first, and hears nothing till then.
            self._wait(lambda status: status & FAULT_MASK == FAULT, failed=True)
            self._sdo[CONTROLWORD].raw = 0
            self._sdo[CONTROLWORD].raw = FAULT_RESET
        self._sdo[MODE].raw = PROFILE_POSITION
        for command in (SHUTDOWN, SWITCH_ON, ENABLE):
            self._sdo[CONTROLWORD].raw = command
        self._wait(lambda status: status & STATE_MASK == ENABLED)

    def move(self, target: int) -> None:
        """Go there and wait until the axis has got there.

        Args:
            target: Position [increments].

        Raises:
            DriveFault: It failed on the way.
        """
        self._sdo[TARGET].raw = target
        self._sdo[CONTROLWORD].raw = GO
        self._wait(lambda status: status & TAKEN)
        self._sdo[CONTROLWORD].raw = ENABLE
        self._wait(lambda status: status & REACHED)

    def _wait(self, true: Callable[[int], object], *, failed: bool = False) -> None:
        until = time.monotonic() + WITHIN_S
        while not true(status := self._sdo[STATUSWORD].raw):
            if status & FAULT_BIT and not failed:
                raise DriveFault(self._sdo[ERROR_CODE].raw)
            if time.monotonic() > until:
                raise TimeoutError(f"the drive stays at statusword {status:04X}h")
            time.sleep(0.01)
