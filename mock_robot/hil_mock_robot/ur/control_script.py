"""The control script that `ur-rtde` uploads, emulated: commands in registers, tick by tick.

The client writes a command number and its arguments into input registers and waits for READY and
DONE in an output register (docs/reference/mock-ur-control.md). Source: behaviour of the script
that ur-rtde 1.6.5 uploads, for each version of the controller's software.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.contact import Touch
from hil_mock_robot.ur.control_moves import MOVES
from hil_mock_robot.ur.control_queries import QUERIES
from hil_mock_robot.ur.control_settings import SETTINGS
from hil_mock_robot.ur.control_streams import STREAMS
from hil_mock_robot.ur.control_touch import TOUCHES
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.motions import Leg
from hil_mock_robot.ur.operation import Operation
from hil_mock_robot.ur.poses import Numbers
from hil_mock_robot.ur.registers import Registers
from hil_mock_robot.ur.threaded import Steps, Threaded

READY, DONE = 1, 2
NO_COMMAND, STOP_SCRIPT = 0, 255
CONTINUOUS = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Commands that are carried out anew in every tick, as long as they stand in the register."""


class ControlScript(Threaded):
    """What plays on the controller while `RTDEControlInterface` is connected.

    Args:
        offset: Number of its first register, 0 or 24.
        path: What MOVE_PATH follows: each move with what it tells before it begins.

    Attributes:
        registers: Known from `begin` on.
        path: See above.
        operation: How far the asynchronous operation is.
        touch: What the tool touches, and where the joints were.
        internal: A command the script gives itself.
        stop_linear: Whether stopJ and stopL stop along a line in tool space: the script remembers.
        servo: What the servo thread aims at: joints (6,), time, lookahead, gain.
        speed, jog: What those threads keep: whether of the TCP, speed (6,), acceleration.
        contact: Ticks since the contact that its thread has seen.
        waypoint: (6,) TCP pose the present move leads to, None before the first.
    """

    registers: Registers
    operation: Operation

    def __init__(self, offset: int = 0, path: Sequence[tuple[tuple[int, ...], Leg]] = ()) -> None:
        super().__init__("rtde_control")
        self._offset = offset
        self.path = tuple(path)
        self.touch = Touch()
        self.internal = NO_COMMAND
        self.stop_linear = False
        self.waypoint: Numbers | None = None
        self.servo: tuple[FloatArray, float, float, float] = (np.zeros(6), 0.0, 0.1, 300.0)
        self.speed = self.jog = (True, np.zeros(6), 0.0)
        self.contact = 0

    def tick(self, machine: Machine) -> bool:
        """See `Program`."""
        self.touch.look(machine)
        return super().tick(machine)

    def main(self) -> Steps:
        """Carry out what stands in the command register, until it says stop."""
        self.registers = Registers(self.machine, self._offset)
        self.operation = Operation(self.registers)
        executed = False
        self._signal(READY)
        while True:
            command = self._command()
            if command in CONTINUOUS:
                yield from self._carry_out(command)
                self._signal(READY)
            elif command == NO_COMMAND:
                executed = False
                self._signal(READY)
            elif not executed:
                yield from self._carry_out(command)
                if command == STOP_SCRIPT:
                    return
                self._signal(DONE)
                executed = True
            yield

    def has(self, cb3: tuple[int, int] | None, e: tuple[int, int] | None) -> bool:
        """Whether the script for this controller has what came with these versions."""
        return self.machine.series.at_least(cb3, e)

    def _command(self) -> int:
        command = self.registers.integer(0)
        if command == NO_COMMAND:
            command, self.internal = self.internal, NO_COMMAND
        return command

    def _carry_out(self, command: int) -> Steps:
        handler = HANDLERS.get(command)
        steps = handler(self) if handler is not None else None
        if steps is not None:
            yield from steps

    def _signal(self, state: int) -> None:
        self.registers.put_integer(0, state)


HANDLERS: dict[int, Callable[[ControlScript], Steps | None]] = {
    **MOVES,
    **QUERIES,
    **SETTINGS,
    **STREAMS,
    **TOUCHES,
}
