"""Tables of the benchmark: text within a hundred columns, and the numbers for whoever computes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from hil.core.typing import FloatArray


@dataclass
class Table:
    """One table of a report.

    Attributes:
        title: What it shows, with units and how it was judged.
        header: Column heads.
        rows: Texts.
        notes: Below the table.
    """

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, *cells: str | Iterable[str]) -> None:
        """Add a row; lists of cells are spread."""
        spread: list[str] = []
        for cell in cells:
            spread += [cell] if isinstance(cell, str) else list(cell)
        self.rows.append(tuple(spread))

    def to_dict(self) -> dict[str, Any]:
        """For `hil bench`."""
        return {
            "title": self.title,
            "header": list(self.header),
            "rows": [list(row) for row in self.rows],
            "notes": self.notes,
        }


@dataclass
class Section:
    """What one part of the benchmark found.

    Attributes:
        tables: In order.
        figures: By name.
        ratios: By name, 1 or less is as good as what it is compared with.
        skipped: What was left out, and why.
    """

    tables: list[Table] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    ratios: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def slug(*words: str) -> str:
    """Return the name of a figure: `LMI, weighted` becomes `lmi_weighted`."""
    return "_".join(re.sub(r"[^a-z0-9]+", "_", word.lower()).strip("_") for word in words)


def numbers(values: Sequence[float] | FloatArray, form: str = ".3f") -> list[str]:
    """Each as text."""
    return [format(float(value), form) for value in values]


def joints(count: int) -> tuple[str, ...]:
    """`J1`, `J2` and so on."""
    return tuple(f"J{i}" for i in range(1, count + 1))
