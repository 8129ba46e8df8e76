"""What a study found, in a terminal: sentences and tables, as wide as there is room."""

from __future__ import annotations

from collections.abc import Iterator

import typer

from hil.cli.output import fold, lines_of, out_width
from hil.report import columns_of, is_numeric, protocol_mark
from hil.studies import StudyResult, Table, Value


def print_study(result: StudyResult) -> None:
    """Print title, summary, warnings, and all tables of a study, or a short one in their place."""
    width = out_width()
    for text in (result.title, *result.summary):
        typer.echo(fold(text, width))
    for warning in result.warnings:
        typer.echo(fold(f"Warning: {warning}", width))
    for title, table in _shown(result):
        typer.echo("\n" + fold(title, width))
        for line in table_lines(table, width):
            typer.echo(line)
        if table.note:
            typer.echo(fold(table.note, width))
    typer.echo("")


def _shown(result: StudyResult) -> Iterator[tuple[str, Table]]:
    for part in result.parts:
        for table in part.tables:
            mark = protocol_mark(part.protocol)
            title = f"{part.title}{f' ({mark})' if mark else ''}: {table.title}"
            if table.key == "table-load-errors":
                yield title, _means(table)
            elif result.study != "load-validation":
                yield title, table


def _means(errors: Table) -> Table:
    """The means of a table of errors by `load, model, what it is told`; the page has the rest."""
    by_row: dict[str, dict[str, Value]] = {}
    for name, *_, mean in errors.rows:
        row, _, told = str(name).rpartition(", ")
        by_row.setdefault(row, {})[told] = mean
    told_of = list(dict.fromkeys(told for row in by_row.values() for told in row))
    rows = tuple((name, *(row.get(told) for told in told_of)) for name, row in by_row.items())
    note = "Means over the joints; joints, declarations and identified loads are on the page."
    return Table(errors.key, errors.title, ("load, model", *told_of), rows, note)


def table_lines(table: Table, width: int | None) -> Iterator[str]:
    """A table as lines; where it is too wide, in blocks of columns that all begin with the names.

    Args:
        table: What to show.
        width: Columns of the terminal; None for a pipe, where nothing is broken.
    """
    yield from lines_of(_columns(table), width)


def _columns(table: Table) -> list[list[str]]:
    """The texts of each column below its heading, all as wide as the widest."""
    out = []
    for i, (title, texts) in enumerate(zip(table.columns, columns_of(table), strict=True)):
        width = max(map(len, (title, *texts)))
        right = is_numeric(table, i)
        out.append([text.rjust(width) if right else text.ljust(width) for text in (title, *texts)])
    return out
