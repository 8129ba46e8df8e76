"""What a reader hands over: numbers as they stand in the file, and which rows are no good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, IntArray

SHOWN = 10
"""Bad rows that are listed in a message; their number is always given."""


@dataclass(eq=False)
class Raw:
    """A file's samples before units are applied.

    Attributes:
        columns: `t` (N,) and quantities (N, n), NaN where nothing could be read.
        lines: (N,) where each sample stands in the file, counted from 1.
        place: What `lines` counts: `line`, `message` or `sample`.
        problems: Row (from 0) → what is wrong with it; the first problem found stays.
    """

    columns: dict[str, FloatArray]
    lines: IntArray
    place: str = "line"
    problems: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def blame(self, row: int, why: str) -> None:
        """Note that a row is no good, unless something worse was said before."""
        self.problems.setdefault(int(row), why)

    @property
    def good(self) -> BoolArray:
        """(N,) rows nothing is wrong with."""
        keep = np.ones(len(self), dtype=bool)
        keep[list(self.problems)] = False
        return keep

    @property
    def bad_lines(self) -> list[int]:
        """Where the bad rows stand in the file."""
        return [int(self.lines[row]) for row in sorted(self.problems)]

    def listing(self) -> Iterator[str]:
        """The first bad rows, one line each, and how many more there are."""
        for row in sorted(self.problems)[:SHOWN]:
            yield f"  {self.place} {self.lines[row]}: {self.problems[row]}"
        if len(self.problems) > SHOWN:
            yield f"  … and {len(self.problems) - SHOWN} more"

    def window(self, rows: tuple[int, int]) -> Raw:
        """Rows first…last, counted from 1, both included.

        Raises:
            DataError: The window is empty or leaves the file.
        """
        first, last = rows
        if not 1 <= first <= last <= len(self):
            raise DataError(
                f"rows {first}:{last} are not in the file, which has rows 1:{len(self)}",
                hint="rows count from 1, the header is not one of them",
            )
        span = slice(first - 1, last)
        shifted = {
            r - span.start: why for r, why in self.problems.items() if first <= r + 1 <= last
        }
        columns = {name: values[span] for name, values in self.columns.items()}
        return Raw(columns, self.lines[span], self.place, shifted)

    def without_bad_rows(self) -> Raw:
        """Only the good rows."""
        keep = self.good
        columns = {name: values[keep] for name, values in self.columns.items()}
        return Raw(columns, self.lines[keep], self.place)
