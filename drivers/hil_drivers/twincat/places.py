"""Where variables are in a PLC, and what their bytes hold."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Place:
    """Where a variable is.

    Attributes:
        group, offset: Index group and offset; or the group of handles, and a handle.
        size: In bytes.
    """

    group: int
    offset: int
    size: int


HANDLE_BY_NAME, VALUE_BY_HANDLE, RELEASE_HANDLE = 0xF003, 0xF005, 0xF006
INFO_BY_NAME, SUM_READ = 0xF009, 0xF080
"""Index groups of ADS."""

VERSION = Place(0xF008, 0, 1)
"""Version of the PLC's symbols: another one once its program was changed online."""


@cache
def block(size: int) -> type[ctypes.Structure]:
    """So many bytes as one value: `pyads` takes arrays apart, byte by byte."""
    return type(
        f"Block{size}", (ctypes.Structure,), {"_fields_": [("bytes", ctypes.c_ubyte * size)]}
    )


def one(data: bytes, kind: np.dtype[Any]) -> np.void:
    """The structure that bytes hold."""
    found: np.void = np.frombuffer(data, kind)[0]
    return found
