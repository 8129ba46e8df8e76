"""Output of the verbs: one JSON document with `--json`, otherwise text and tables.

On a terminal, text is wrapped to the width of the terminal, and tables are laid out without losing
digits. In a pipe, no line of text is wrapped. The width of the terminal is read at each call,
because a terminal may be resized at any time.
"""

import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import indent, wrap
from typing import Any, TextIO

import typer

from hil.core import HilError, exit_code_of, json_text, name_text


def ignore_from_now_on() -> None:
    """Ignore Ctrl-C and similar signals, which must no longer change report or exit code."""
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            if (number := getattr(signal, name, None)) is not None:
                signal.signal(number, signal.SIG_IGN)


def print_json(document: Any) -> None:
    """Print a document as JSON; NaN and infinity, which JSON does not support, become null."""
    typer.echo(json_text(_finite(document), indent=1))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def fail(error: HilError, json: bool) -> None:
    """End with the exit code of an error after the result has been printed.

    Raises:
        HilError: The error that was passed, which `main` prints.
        Exit: The option `json` is set, so standard output already contains the document; the error
            is printed on standard error.
    """
    if not json:
        raise error
    typer.echo(f"{type(error).__name__}: {error}", err=True)
    raise typer.Exit(exit_code_of(error))


def say(text: str, margin: str = "") -> None:
    """Print text that is wrapped on a terminal.

    Args:
        text: Text of one or more lines.
        margin: Text that is printed before each line.
    """
    width = out_width()
    typer.echo(indent(fold(text, width and width - len(margin)), margin))


def print_warnings(warnings: Iterable[str]) -> None:
    """Print each warning on a separate line."""
    for warning in warnings:
        say(f"warning: {warning}")


def print_run(run: Path) -> None:
    """Print the summary of a run, as wide as the terminal allows."""
    from hil.report import WIDTH, summary_lines

    for line in summary_lines(run, max(40, min(WIDTH, out_width() or WIDTH))):
        typer.echo(line)


def fixed(value: float, decimals: int) -> str:
    """Return a number with a fixed number of decimals; a number that rounds to zero has no sign."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


# Tables

GAP = "  "
"""Text that separates two columns."""

LEAST_PROSE = 20
"""Minimum width of the last column if its words are wrapped [characters]."""

NARROW_SPACE = "\u202f"
"""Space character between groups of three digits; printable, although Python's `isprintable`
accepts only one space."""


def print_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], *, right: Collection[int] = ()
) -> None:
    """Print a table in the layout of `table_lines`."""
    for line in table_lines(header, rows, right=right, width=out_width()):
        typer.echo(line)


def table_lines(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    right: Collection[int] = (),
    width: int | None,
) -> list[str]:
    """Return a table as lines that fit the terminal and keep every digit.

    The first layout in the following list that fits the terminal is used. (The library rich
    shortens numbers and headings instead: see docs/decisions/0036.)

    - Whole table: all columns are side by side. In a pipe, this layout is always used.
    - Wrapped: the words of the last column are wrapped within it, as in lists of descriptions.
    - Blocks: as many columns as fit are printed, and the next columns follow below. In the layout
      with blocks, each block begins with the first column, which names the rows; the first column
      must be narrow, and its names must be unique.
    - Row by row: the first cell is followed by `heading: cell` for all cells that are not empty.

    Args:
        header: Headings of the columns; all empty if the rows are names and values.
        rows: Cells. Control characters in the cells are shown as escape sequences.
        right: Indices of the right-aligned columns, such as columns of numbers.
        width: Width of the terminal in columns; None in a pipe.
    """
    table = [[_printable(text) for text in row] for row in (header, *rows)]
    wide = [max(map(len, column)) for column in zip(*table, strict=True)]
    columns = [
        [text.rjust(wide[i]) if i in right else text.ljust(wide[i]) for text in column]
        for i, column in enumerate(zip(*table, strict=True))
    ]
    before_last = sum(wide[:-1]) + len(GAP) * (len(wide) - 1)
    if width is None or before_last + wide[-1] <= width:
        return _side_by_side(columns)
    if len(wide) == 1:
        return [fold(name, width) for (name,) in table]
    longest = max((len(word) for row in table for word in row[-1].split()), default=0)
    if width - before_last >= max(LEAST_PROSE, longest):
        return list(_last_wrapped(columns, width - before_last))
    names = [row[0] for row in table]
    room = width - len(GAP) - wide[0]
    if len(set(names)) == len(names) and room >= max(width // 2, *wide[1:]):
        return [line for block in _blocks(columns, width) for line in _side_by_side(block)]
    return list(_row_by_row(table, width))


def _printable(text: str) -> str:
    return text if text.replace(NARROW_SPACE, "").isprintable() else name_text(text)


def _side_by_side(columns: Sequence[Sequence[str]]) -> list[str]:
    return [GAP.join(cells).rstrip() for cells in zip(*columns, strict=True)]


def _last_wrapped(columns: Sequence[Sequence[str]], room: int) -> Iterator[str]:
    for *cells, last in zip(*columns, strict=True):
        first, *others = wrap(last, room, break_on_hyphens=False) or [""]
        beginning = "".join(f"{cell}{GAP}" for cell in cells)
        yield f"{beginning}{first}".rstrip()
        yield from (" " * len(beginning) + line for line in others)


def _blocks(columns: Sequence[Sequence[str]], width: int) -> Iterator[list[Sequence[str]]]:
    names, *others = columns
    block, used = [names], len(names[0])
    for column in others:
        needed = len(GAP) + len(column[0])
        if used + needed > width and len(block) > 1:
            yield block
            block, used = [names], len(names[0])
        block.append(column)
        used += needed
    yield block


def _row_by_row(table: Sequence[Sequence[str]], width: int) -> Iterator[str]:
    (_, *titles), *rows = table
    for name, *cells in rows:
        if not any(titles):
            yield fold(GAP.join([name, *filter(None, cells)]), width)
            continue
        yield name
        filled = (f"{title}: {cell}" for title, cell in zip(titles, cells, strict=True) if cell)
        if text := ", ".join(filled):
            yield indent(fold(text, width - len(GAP)), GAP)


def print_errors(
    heading: str, errors: Iterable[tuple[str, Sequence[float | None]]], *, mean: bool = True
) -> None:
    """Print one error per joint in each row.

    Args:
        heading: Heading of the first column: the name of the metric and its unit.
        errors: Name of each row and its errors per joint; None for a row without errors.
        mean: Whether to add a column with the mean over the joints.
    """
    rows, joints = [], 0
    for name, values in errors:
        joints = len(values)
        known = [value for value in values if value is not None]
        means = [sum(known) / len(known) if known else None] if mean else []
        cells = ("–" if value is None else f"{value:.4f}" for value in (*values, *means))
        rows.append((name, *cells))
    header = [heading, *(f"J{j + 1}" for j in range(joints)), *(["mean"] if mean else [])]
    print_table(header, rows)


# Width


def fold(text: str, width: int | None) -> str:
    """Return text wrapped between words, but not within long words; unchanged without a width."""
    if width is None:
        return text
    lines = (
        wrap(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
        for line in text.splitlines()
    )
    return "\n".join("\n".join(line) for line in lines)


def out_width() -> int | None:
    """Return the width of standard output in columns; None in a pipe.

    The variable $COLUMNS is ignored for a pipe, because every Python process that has loaded
    readline sets this variable for its child processes.
    """
    return width_of(sys.stdout)


def width_of(stream: TextIO) -> int | None:
    """Return the width of a stream's terminal in columns; None if the stream is not a terminal."""
    if not stream.isatty():
        return None
    columns = 0
    with contextlib.suppress(ValueError):
        columns = int(os.environ.get("COLUMNS", ""))
    with contextlib.suppress(OSError, ValueError):
        columns = columns or os.get_terminal_size(stream.fileno()).columns
    return max(columns or 80, 20)
