"""How the numbers and protocols of studies are said, on the page, in the terminal and on paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median_low

from hil.report.words import UNKNOWN, in_words, number
from hil.study.result import StudyResult, Table, Value

HONEST = "honest"

DIGITS = 3
"""Significant digits of the median of a column, and of any number that stands by itself."""
MOST_DIGITS = 6
"""A column whose largest number would take more is not brought to common decimals."""


def columns_of(table: Table) -> list[list[str]]:
    """The texts of each column; the numbers of one have equally many decimals where they can."""
    return [_column([row[i] for row in table.rows]) for i in range(len(table.columns))]


def distinct_titles(studies: Sequence[StudyResult]) -> list[str]:
    """Title of each study; of those with equal titles, with the parameters they differ in."""
    out = []
    for study in studies:
        alike = [other.parameters for other in studies if other.title == study.title]
        own = [
            f"{key} {in_words(value)}"
            for key, value in study.parameters.items()
            if any(other.get(key) != value for other in alike)
        ]
        out.append(f"{study.title} ({', '.join(own)})" if own else study.title)
    return out


def is_numeric(table: Table, i: int) -> bool:
    """Whether a column holds numbers only; the first names the rows."""
    return i > 0 and not any(isinstance(row[i], str) for row in table.rows)


def protocol_mark(protocol: str) -> str:
    """`honest protocol`, `paper protocol`; empty for parts about no model."""
    word = protocol.partition(":")[0].strip()
    return f"{word} protocol" if word else ""


def _column(values: Sequence[Value]) -> list[str]:
    decimals = _decimals([value for value in values if isinstance(value, float)])
    return [_text(value, decimals) for value in values]


def _decimals(values: Sequence[float]) -> int | None:
    """How many decimals suit all of some numbers; None where each needs its own."""
    sizes = [abs(value) for value in values if math.isfinite(value) and value]
    if not sizes:
        return None
    middle, high = (math.floor(math.log10(size)) for size in (median_low(sizes), max(sizes)))
    decimals = max(0, DIGITS - 1 - middle)
    return decimals if high + 1 + decimals <= MOST_DIGITS else None


def _text(value: Value, decimals: int | None) -> str:
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        # A number far below the others keeps digits of its own: it is small, and not nothing.
        shown = decimals is not None and (value == 0 or abs(value) >= 0.5 * 10.0**-decimals)
        return f"{value:.{decimals}f}" if shown else number(value, DIGITS)
    return str(value)
