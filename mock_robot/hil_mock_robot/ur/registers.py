"""The registers a program shares with its clients, seen from the program."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.machine import Machine

INT32 = 2**31
LARGEST = 1e9
"""What no pose, speed or force is beyond: larger numbers only overflow."""


class Registers:
    """Input registers to read and output registers to write, from number `offset` on.

    Args:
        machine: Whose registers.
        offset: 0, or 24 for the upper range.

    Raises:
        CommandRefused: This software has no upper range.
    """

    def __init__(self, machine: Machine, offset: int = 0) -> None:
        self.offset = offset
        self._in, self._out = machine.inputs, machine.outputs
        starts = [f"input_int_register_{offset}", f"output_int_register_{offset}"]
        if any(
            name not in values for name, values in zip(starts, (self._in, self._out), strict=True)
        ):
            raise CommandRefused(f"there is no register {offset} in this software")
        self._ints = self._in.variables[f"input_int_register_{offset}"].offset
        self._doubles = self._in.variables[f"input_double_register_{offset}"].offset

    def integer(self, number: int) -> int:
        """An integer that a client has written."""
        return int(self._in.flat[self._ints + number])

    def double(self, number: int) -> float:
        """A number that a client has written.

        Raises:
            CommandRefused: It is too large for any physical quantity, or no number at all.
        """
        value = float(self._in.flat[self._doubles + number])
        if not abs(value) <= LARGEST:
            raise CommandRefused(f"input double register {self.offset + number} is {value}")
        return value

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        """(count,) numbers that a client has written; see `double`."""
        return np.array([self.double(first + i) for i in range(count)])

    def put_integer(self, number: int, value: int) -> None:
        """Tell clients an integer.

        Raises:
            CommandRefused: There is no such register, or it does not hold such a value.
        """
        name = f"output_int_register_{self.offset + number}"
        if name not in self._out or not -INT32 <= value < INT32:
            raise CommandRefused(f"cannot write {value} to {name}")
        self._out[name] = int(value)

    def put_doubles(self, first: int, values: Iterable[float]) -> None:
        """Tell clients some numbers.

        Raises:
            CommandRefused: There is no such register.
        """
        for number, value in enumerate(values, self.offset + first):
            name = f"output_double_register_{number}"
            if name not in self._out:
                raise CommandRefused(f"there is no {name}")
            self._out[name] = float(value)
