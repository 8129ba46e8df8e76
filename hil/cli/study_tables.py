"""What a study found, in a terminal: sentences and tables, as wide as there is room."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

import typer

from hil.cli.output import fold, width_of
from hil.report.study_words import columns_of, is_numeric, protocol_mark
from hil.study.result import StudyResult, Table

APART = 2
"""Blanks between two columns."""


def print_study(result: StudyResult) -> None:
    """Print title, summary, warnings, and all tables of a study."""
    width = width_of(sys.stdout)
    for text in (result.title, *result.summary):
        typer.echo(fold(text, width))
    for warning in result.warnings:
        typer.echo(fold(f"Warning: {warning}", width))
    for part in result.parts:
        for table in part.tables:
            mark = protocol_mark(part.protocol)
            title = f"{part.title}{f' ({mark})' if mark else ''}: {table.title}"
            typer.echo("\n" + fold(title, width))
            for line in table_lines(table, width):
                typer.echo(line)
            if table.note:
                typer.echo(fold(table.note, width))
    typer.echo("")


def table_lines(table: Table, width: int | None) -> Iterator[str]:
    """A table as lines; where it is too wide, in blocks of columns that all begin with the names.

    Args:
        table: What to show.
        width: Columns of the terminal; None for a pipe, where nothing is broken.
    """
    names, *others = _columns(table)
    room = len(names[0]) if names else 0
    for block in _blocks(others, None if width is None else width - room):
        for i, name in enumerate(names):
            yield (" " * APART).join([name, *(column[i] for column in block)]).rstrip()


def _columns(table: Table) -> list[list[str]]:
    """The texts of each column below its heading, all as wide as the widest."""
    out = []
    for i, (title, texts) in enumerate(zip(table.columns, columns_of(table), strict=True)):
        width = max(map(len, (title, *texts)))
        right = is_numeric(table, i)
        out.append([text.rjust(width) if right else text.ljust(width) for text in (title, *texts)])
    return out


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
