"""How verbs print: one JSON document with `--json`, otherwise text a person reads."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any, TextIO

import typer

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


def print_json(document: Any) -> None:
    """Print a document; NaN and infinity become null, since JSON has neither."""
    typer.echo(json.dumps(_finite(document), ensure_ascii=False, indent=1))


def print_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Columns separated by two blanks, as wide as needed; nothing is cut, so pipes get it all."""
    table = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    for row in table:
        typer.echo("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())


def print_warnings(warnings: Iterable[str]) -> None:
    """A line each, wrapped on a terminal."""
    for warning in warnings:
        typer.echo(fold(f"warning: {warning}", width_of(sys.stdout)))


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
