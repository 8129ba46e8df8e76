"""Pieces of a C program, and numbers and arrays as C has them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.core import FloatArray

Kind = Literal["double", "float"]


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of the program; the parts are put behind each other in this order.

    Attributes:
        constants: `static const` arrays.
        state: Members of the state structure, what is remembered from sample to sample.
        functions: `static` functions, those they call first.
        reset: Statements that set the members of `s`, a pointer to the state, to the start.
    """

    constants: str = ""
    state: str = ""
    functions: str = ""
    reset: str = ""


def comment(text: str) -> str:
    """Foreign text as it may stand in a comment: what could end one, or begin a line, becomes `_`.

    Names of joints, robots and estimators come from files that others wrote.
    """
    return re.sub(r"[^A-Za-z0-9_ .,+-]", "_", text)


def number(value: float, kind: Kind = "double") -> str:
    """A literal that is read back to the same bits.

    Raises:
        ValueError: It is not finite.
    """
    if not np.isfinite(value):
        raise ValueError(f"{value} cannot be a constant of a program")
    text = f"{np.float32(value)!s}" if kind == "float" else repr(float(value))
    if "." not in text and "e" not in text:
        text += ".0"
    return text + ("f" if kind == "float" else "")


def array(name: str, values: FloatArray, kind: Kind = "double") -> str:
    """A `static const` array of any shape, with its initialiser.

    Raises:
        ValueError: A value is not finite.
    """
    values = np.asarray(values)
    sizes = "".join(f"[{size}]" for size in values.shape)
    return f"static const {kind} {name}{sizes} = {_braced(values, kind)};\n"


def _braced(values: FloatArray, kind: Kind) -> str:
    if values.ndim == 0:
        return number(float(values), kind)
    parts = [_braced(one, kind) for one in values]
    if values.ndim > 1:
        return "{\n" + ",\n".join(parts) + "}"
    lines = [", ".join(parts[first : first + 6]) for first in range(0, len(parts), 6)]
    return "{" + ",\n ".join(lines) + "}"
