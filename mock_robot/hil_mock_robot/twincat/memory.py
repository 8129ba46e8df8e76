"""The PLC's memory: variables by name, and the bytes that ADS reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np

from hil.core import StructArray
from hil_mock_robot.twincat.structured_text import Declarations, declared_in

DATA = 0x4040
"""Index group of a PLC's global data, as TwinCAT has it."""

FIRST = 0x100
"""Offset of the first variable: 0 would hide a mix-up."""

PREFIX = "GVL_Hil"
MOVED = 64
"""So many bytes farther on everything lies after an online change: what is written to where a
variable was lands in its neighbour."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """A variable as ADS tells it.

    Attributes:
        name: Qualified, as it is declared.
        type: As declared.
        offset: In the index group of data.
        size: In bytes.
    """

    name: str
    type: str
    offset: int
    size: int


class Memory:
    """The global variables of the contract.

    Args:
        without: Variables that this PLC does not have.
        declarations: What it has; the contract's.

    Attributes:
        symbols: Lower-case qualified name → symbol: TwinCAT's names have no case.
        version: Of the symbols; another one after an online change.
    """

    def __init__(
        self, without: Sequence[str] = (), declarations: Declarations | None = None
    ) -> None:
        self.declarations = declarations or contract()
        self.symbols: dict[str, Symbol] = {}
        self.version, self._moved = 1, 0
        self._types: dict[str, np.dtype[Any]] = {}
        self._offsets: dict[str, int] = {}
        end = FIRST
        for name, (written, kind) in self.declarations.variables.items():
            symbol = Symbol(f"{PREFIX}.{name}", written, end, kind.itemsize)
            self._types[name], self._offsets[name] = kind, end
            if name not in without:
                self.symbols[symbol.name.lower()] = symbol
            end += -(-kind.itemsize // 8) * 8
        self.bytes = bytearray(end)
        for name, value in self.declarations.initial.items():
            self.view(name)[0] = value

    def view(self, name: str) -> StructArray:
        """A variable to be changed in place: structures and numbers have shape (1,)."""
        kind, offset = self._types[name], self._offsets[name]
        base, shape = (kind.subdtype[0], kind.subdtype[1]) if kind.subdtype else (kind, (1,))
        return np.frombuffer(self.bytes, base, count=shape[0], offset=offset)

    def clear(self, name: str) -> None:
        """All bytes of a variable become 0."""
        view = self.view(name)
        view[:] = np.zeros((), view.dtype)

    def offset(self, name: str) -> int:
        """Where in `bytes` a variable is."""
        return self._offsets[name]

    def online_change(self) -> None:
        """The program is changed while it runs: every variable lies elsewhere for ADS."""
        self.version = self.version % 255 + 1
        self._moved += MOVED
        for name, symbol in self.symbols.items():
            self.symbols[name] = replace(symbol, offset=symbol.offset + MOVED)

    def at(self, offset: int, size: int) -> int | None:
        """Where in `bytes` an offset of ADS is; None where so many bytes are no data."""
        start = offset - self._moved
        return start if start >= FIRST and start + size <= len(self.bytes) else None


def contract() -> Declarations:
    """The contract between driver and PLC, as it is declared in structured text."""
    text = files("hil_mock_robot.twincat").joinpath("contract.st").read_text("utf-8")
    return declared_in(text)
