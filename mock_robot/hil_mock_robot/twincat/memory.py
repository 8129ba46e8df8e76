"""Memory of the PLC: variables by name, and the bytes that ADS reads and writes.

`Memory` contains the global variables of the contract between driver and PLC. `declared_in`
computes the layout of the variables from declarations in structured text, in the subset of the
language that `contract.st` uses. `entry_of` is the ADS description of a variable.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any

import numpy as np

from hil.core import PluginError, StructArray

DATA = 0x4040
"""Index group of a PLC's global data, as in TwinCAT."""

FIRST = 0x100
"""Offset of the first variable; with an offset of 0, mix-ups of addresses would not be noticed."""

PREFIX = "GVL_Hil"

MOVED = 64
"""Shift of all variables after an online change [bytes]; a write to an old address changes a
neighbouring variable."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """Description of one variable of the PLC for ADS.

    Attributes:
        name: Qualified name, as declared.
        type: Type, as declared.
        offset: Offset in the index group of data [bytes].
        size: Size of the variable [bytes].
    """

    name: str
    type: str
    offset: int
    size: int


class Memory:
    """Global variables of the contract.

    Args:
        without: Names of variables that this PLC lacks.
        declarations: Declarations of the variables; None for the declarations of the contract.

    Attributes:
        symbols: Map from qualified name in lower case to symbol; names in TwinCAT are
            case-insensitive.
        version: Version of the symbols, which an online change increments.
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
        """Return a writable view of a variable; a structure or number has shape (1,)."""
        kind, offset = self._types[name], self._offsets[name]
        base, shape = (kind.subdtype[0], kind.subdtype[1]) if kind.subdtype else (kind, (1,))
        return np.frombuffer(self.bytes, base, count=shape[0], offset=offset)

    def clear(self, name: str) -> None:
        """Set all bytes of a variable to 0."""
        view = self.view(name)
        view[:] = np.zeros((), view.dtype)

    def offset(self, name: str) -> int:
        """Return the index of a variable in `bytes`."""
        return self._offsets[name]

    def online_change(self) -> None:
        """Simulate an online change: every variable gets a different ADS address."""
        self.version = self.version % 255 + 1
        self._moved += MOVED
        for name, symbol in self.symbols.items():
            self.symbols[name] = replace(symbol, offset=symbol.offset + MOVED)

    def at(self, offset: int, size: int) -> int | None:
        """Return the index in `bytes` of an ADS offset; None if the range is outside the data."""
        start = offset - self._moved
        return start if start >= FIRST and start + size <= len(self.bytes) else None


def contract() -> Declarations:
    """Return the contract between driver and PLC, as declared in structured text."""
    text = files("hil_mock_robot.twincat").joinpath("contract.st").read_text("utf-8")
    return declared_in(text)


ELEMENTARY = {"LREAL": "<f8", "ULINT": "<u8", "UDINT": "<u4", "DINT": "<i4"}


@dataclass(slots=True)
class Declarations:
    """Declarations of a file in structured text.

    Attributes:
        constants: Name → value.
        types: Structure → dtype.
        variables: Map from global variable to its type as written and its dtype.
        initial: Map from global variable to its declared initial value.
    """

    constants: dict[str, int] = field(default_factory=dict)
    types: dict[str, np.dtype[Any]] = field(default_factory=dict)
    variables: dict[str, tuple[str, np.dtype[Any]]] = field(default_factory=dict)
    initial: dict[str, int] = field(default_factory=dict)


_COMMENT = re.compile(r"\(\*.*?\*\)|\{.*?\}", re.DOTALL)
_VARIABLES = re.compile(r"VAR_GLOBAL(\s+CONSTANT)?(.*?)END_VAR", re.DOTALL)
_STRUCT = re.compile(r"TYPE\s+(\w+)\s*:\s*STRUCT(.*?)END_STRUCT", re.DOTALL)
_DECLARED = re.compile(r"(\w+)\s*:\s*([^;]+?)\s*;")


def declared_in(text: str) -> Declarations:
    """Return the layout of the structures and global variables declared in a text.

    Raises:
        PluginError: The text uses an unsupported declaration, or a structure needs padding.
    """
    text, found = _COMMENT.sub("", text), Declarations()
    blocks = _VARIABLES.findall(text)
    for constant, body in blocks:
        if constant:
            found.constants |= {
                name: int(value.split(":=")[1]) for name, value in _DECLARED.findall(body)
            }
    for name, body in _STRUCT.findall(text):
        fields = [(each, _type(written, found)) for each, written in _DECLARED.findall(body)]
        found.types[name] = _without_padding(name, np.dtype(fields))
    for constant, body in blocks:
        if not constant:
            for name, declared in _DECLARED.findall(body):
                written, _, value = (part.strip() for part in declared.partition(":="))
                found.variables[name] = written, _type(written, found)
                if value:
                    found.initial[name] = int(value)
    return found


_STRING = re.compile(r"STRING\((\d+)\)")
_ARRAY = re.compile(r"ARRAY\[0\.\.(.+?)\]\s*OF\s+(\w+)")


def _type(written: str, found: Declarations) -> np.dtype[Any]:
    if written in ELEMENTARY:
        return np.dtype(ELEMENTARY[written])
    if match := _STRING.fullmatch(written):
        return np.dtype(f"S{int(match[1]) + 1}")
    if match := _ARRAY.fullmatch(written):
        return np.dtype((_type(match[2], found), (_number(match[1], found) + 1,)))
    if written in found.types:
        return found.types[written]
    raise PluginError(f"the PLC's declarations use a type {written!r} that is not declared")


_MINUS = re.compile(r"(\w+)(?:\s*-\s*(\d+))?")


def _number(written: str, found: Declarations) -> int:
    match = _MINUS.fullmatch(written.strip())
    if match is None:
        raise PluginError(f"the PLC's declarations have an invalid bound {written!r}")
    first = int(match[1]) if match[1].isdigit() else found.constants[match[1]]
    return first - int(match[2] or 0)


def _without_padding(name: str, packed: np.dtype[Any]) -> np.dtype[Any]:
    """Return a structure dtype; raise if its layout depends on the packing of the compiler."""
    fields = [(each, packed[each]) for each in packed.names or ()]
    if np.dtype(fields, align=True).itemsize != packed.itemsize or packed.itemsize % 8:
        raise PluginError(f"structure {name} of the PLC's declarations needs padding")
    return packed


BIG_TYPE = 65
"""ADS data type of a type that is not elementary."""

ADS_TYPES = {"UDINT": 19, "DINT": 3, "LREAL": 5, "ULINT": 21}


def entry_of(symbol: Symbol) -> bytes:
    """Return the ADS symbol entry: sizes, address, name, type and an empty comment."""
    name, kind = symbol.name.encode(), symbol.type.encode()
    texts = name + b"\0" + kind + b"\0\0"
    head = struct.calcsize("<IIIIIIHHH")
    return (
        struct.pack(
            "<IIIIIIHHH",
            head + len(texts),
            DATA,
            symbol.offset,
            symbol.size,
            ADS_TYPES.get(symbol.type, BIG_TYPE),
            0,
            len(name),
            len(kind),
            0,
        )
        + texts
    )
