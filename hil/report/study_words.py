"""How the numbers and protocols of studies are said, on the page, in the terminal and on paper."""

from __future__ import annotations

from hil.report.words import UNKNOWN, number
from hil.study.result import Value

HONEST = "honest"
DIGITS = 4
"""Tables of studies compare methods that differ by a few per cent."""


def cell_text(value: Value) -> str:
    """A value of a table as people read it; a dash where there is none."""
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    return number(value, DIGITS) if isinstance(value, float) else value


def protocol_mark(protocol: str) -> str:
    """`honest protocol`, `paper protocol`; empty for parts about no model."""
    word = protocol.partition(":")[0].strip()
    return f"{word} protocol" if word else ""
