"""How verbs print: one JSON document with `--json`, otherwise text a person reads."""

import contextlib
import math
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import indent, wrap
from typing import Annotated, Any, Self, TextIO

import typer

from hil.core import json_text, name_text

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
SpecPath = Annotated[Path, typer.Argument(help="Experiment spec (YAML).", show_default=False)]
StationOption = Annotated[
    Path | None,
    typer.Option(
        "--station",
        help="Station file; by default $HIL_STATION, station.yaml beside the spec, or the "
        "built-in mock bench.",
    ),
]
RunsOption = Annotated[
    Path, typer.Option("--runs", envvar="HIL_RUNS", help="Where run directories are kept.")
]

APART = 2
"""Blanks between two columns."""

LEAST_PROSE = 20
"""Columns that words at the end of a row are wrapped within; fewer are no pleasure to read."""


def print_json(document: Any) -> None:
    """Print a document; NaN and infinity become null, since JSON has neither."""
    typer.echo(json_text(_finite(document), indent=1))


def print_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Columns as wide as needed, the first of them names; in a pipe nothing is broken.

    In a table wider than the terminal the words at the end of its rows are wrapped. Where that is
    not enough it comes in blocks of columns, each with the names; where these leave no room for
    that, or are shared by rows, row by row, without what is empty.
    """
    table = [[_cell(text) for text in row] for row in (header, *rows)]
    padded = [
        [cell.ljust(max(map(len, column))) for cell in column]
        for column in zip(*table, strict=True)
    ]
    width = out_width()
    for line in _table_lines(table, padded, width):
        typer.echo(line)


def _cell(text: str) -> str:
    """Return the cell text with control characters escaped."""
    return text if text.isprintable() else name_text(text)


def _table_lines(
    table: list[list[str]], padded: list[list[str]], width: int | None
) -> Iterable[str]:
    wide = [len(column[0]) for column in padded]
    if width is None or sum(wide) + APART * (len(wide) - 1) <= width:
        return lines_of(padded, None)
    if len(wide) == 1:
        return (fold(name, width) for (name,) in table)
    before = sum(wide[:-1]) + APART * (len(wide) - 1)
    words = [word for row in table for word in row[-1].split()]
    if width - before >= max([LEAST_PROSE, *map(len, words)]):
        return _wrapped_at_the_end(padded, before, width)
    names = [row[0] for row in table]
    if len(set(names)) < len(names) or wide[0] > width - APART - max(width // 2, *wide[1:]):
        return _row_by_row(table, width)
    return lines_of(padded, width)


def _wrapped_at_the_end(padded: list[list[str]], before: int, width: int) -> Iterator[str]:
    for *cells, last in zip(*padded, strict=True):
        first, *others = wrap(last, width - before, break_on_hyphens=False) or [""]
        yield (" " * APART).join([*cells, first]).rstrip()
        yield from (" " * before + line for line in others)


def _row_by_row(table: list[list[str]], width: int) -> Iterator[str]:
    (_, *titles), *rows = table
    for name, *cells in rows:
        if not any(titles):
            yield fold((" " * APART).join([name, *filter(None, cells)]), width)
            continue
        yield name
        said = (f"{title}: {cell}" for title, cell in zip(titles, cells, strict=True) if cell)
        if told := ", ".join(said):
            yield indent(fold(told, width - APART), " " * APART)


def lines_of(columns: Sequence[list[str]], width: int | None) -> Iterator[str]:
    """Padded columns as lines; where they are too wide, in blocks that all begin with the first.

    Args:
        columns: Texts of each, all as wide as the widest.
        width: Of the terminal; None where nothing is broken.
    """
    names, *others = columns
    room = len(names[0]) if names else 0
    for block in _blocks(others, None if width is None else width - room):
        for i, name in enumerate(names):
            yield (" " * APART).join([name, *(column[i] for column in block)]).rstrip()


def _blocks(columns: Sequence[list[str]], room: int | None) -> Iterator[list[list[str]]]:
    block: list[list[str]] = []
    used = 0
    for column in columns:
        wide = APART + len(column[0])
        if block and room is not None and used + wide > room:
            yield block
            block, used = [], 0
        block.append(column)
        used += wide
    yield block


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals; what rounds to zero has no sign."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def say(text: str) -> None:
    """A line, wrapped on a terminal."""
    typer.echo(fold(text, out_width()))


def print_warnings(warnings: Iterable[str]) -> None:
    """A line each, wrapped on a terminal."""
    for warning in warnings:
        say(f"warning: {warning}")


def fold(text: str, width: int | None) -> str:
    """Text wrapped between words; as it is where there is no width. Paths stay whole."""
    if width is None:
        return text
    lines = (
        wrap(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
        for line in text.splitlines()
    )
    return "\n".join("\n".join(line) for line in lines)


def width_of(stream: TextIO) -> int | None:
    """Columns of the terminal that a stream is, None where it is none; it may change any time."""
    if not stream.isatty():
        return None
    columns = 0
    with contextlib.suppress(ValueError):
        columns = int(os.environ.get("COLUMNS", ""))
    with contextlib.suppress(OSError, ValueError):
        columns = columns or os.get_terminal_size(stream.fileno()).columns
    return max(columns or 80, 20)


def out_width() -> int | None:
    """Columns to print within, None in a pipe.

    $COLUMNS alone is nobody's wish there: every Python that has loaded readline hands it down.
    """
    return width_of(sys.stdout)


class MovingLine:
    """A line of a terminal that moves, above which other lines stay; in a pipe only those are.

    The moving line never wraps: it is cut to the width. Used as a context, it is taken away at the
    end, however that comes.

    Args:
        stream: By default standard error.
        moves: Whether the stream is a terminal; by default found out.
    """

    def __init__(self, stream: TextIO | None = None, *, moves: bool | None = None) -> None:
        self._given = stream
        self.moves = width_of(self._stream) is not None if moves is None else moves
        self._open = False

    @property
    def _stream(self) -> TextIO:
        return self._given or sys.stderr

    def show(self, text: str) -> None:
        """Show what the line says now; nothing in a pipe."""
        if not self.moves:
            return
        room = self._columns() - 1
        self._write(text if len(text) <= room else f"{text[: room - 1]}…")
        self._open = True

    def say(self, text: str) -> None:
        """Leave a line; a terminal wraps it between words, a pipe gets it whole."""
        self._write((fold(text, self._columns()) if self.moves else text) + "\n")
        self._open = False

    def end(self, *, keep: bool = False) -> None:
        """Take the line away, or leave it as it is and begin another below it."""
        if self._open:
            self._stream.write("\n" if keep else "\r\x1b[K")
            self._stream.flush()
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None:
        self.end()

    def _write(self, text: str) -> None:
        start = "\r\x1b[K" if self._open else ""
        self._stream.write(start + text)
        self._stream.flush()

    def _columns(self) -> int:
        return width_of(self._stream) or max(20, shutil.get_terminal_size().columns)


def fit_words(number: int, total: int, name: str) -> str:
    """Which of how many fits it is, the same for those of runs and of studies."""
    return f"fit {number} of {total}: {name}"


def fit_ended(number: int, total: int, name: str, seconds: float, *, failed: bool = False) -> str:
    """What is left on the screen of a fit that is done."""
    which = fit_words(number, total, name)
    return f"{which}{' failed' if failed else ''} ({duration(seconds)})"


def duration(seconds: float) -> str:
    """`75.0 s`, `12 min 5 s` or `1 h 09 min`."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def size(n_bytes: float) -> str:
    """`1.2 MB` and the like, in powers of ten."""
    for unit in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
