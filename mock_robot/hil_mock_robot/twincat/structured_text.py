"""Declarations in structured text as a memory layout: just what `contract.st` is written with."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.core import PluginError

ELEMENTARY = {"LREAL": "<f8", "ULINT": "<u8", "UDINT": "<u4", "DINT": "<i4"}

_COMMENT = re.compile(r"\(\*.*?\*\)|\{.*?\}", re.DOTALL)
_STRUCT = re.compile(r"TYPE\s+(\w+)\s*:\s*STRUCT(.*?)END_STRUCT", re.DOTALL)
_VARIABLES = re.compile(r"VAR_GLOBAL(\s+CONSTANT)?(.*?)END_VAR", re.DOTALL)
_DECLARED = re.compile(r"(\w+)\s*:\s*([^;]+?)\s*;")
_STRING = re.compile(r"STRING\((\d+)\)")
_ARRAY = re.compile(r"ARRAY\[0\.\.(.+?)\]\s*OF\s+(\w+)")
_MINUS = re.compile(r"(\w+)(?:\s*-\s*(\d+))?")


@dataclass(slots=True)
class Declarations:
    """What a file declares.

    Attributes:
        constants: Name → value.
        types: Structure → dtype.
        variables: Global variable → type as written and dtype.
        initial: Global variable → value it begins with, where that is said.
    """

    constants: dict[str, int] = field(default_factory=dict)
    types: dict[str, np.dtype[Any]] = field(default_factory=dict)
    variables: dict[str, tuple[str, np.dtype[Any]]] = field(default_factory=dict)
    initial: dict[str, int] = field(default_factory=dict)


def declared_in(text: str) -> Declarations:
    """Lay out the structures and global variables of a text.

    Raises:
        PluginError: It uses something that is not understood here, or needs padding.
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


def _number(written: str, found: Declarations) -> int:
    match = _MINUS.fullmatch(written.strip())
    if match is None:
        raise PluginError(f"the PLC's declarations have a bound {written!r}")
    first = int(match[1]) if match[1].isdigit() else found.constants[match[1]]
    return first - int(match[2] or 0)


def _without_padding(name: str, packed: np.dtype[Any]) -> np.dtype[Any]:
    """A structure that every packing lays out alike; else it is a mistake in the declarations."""
    fields = [(each, packed[each]) for each in packed.names or ()]
    if np.dtype(fields, align=True).itemsize != packed.itemsize or packed.itemsize % 8:
        raise PluginError(f"structure {name} of the PLC's declarations needs padding")
    return packed
