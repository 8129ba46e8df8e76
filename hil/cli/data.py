"""`hil import`: recordings of other tools, turned into our MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import JsonFlag, print_json
from hil.errors import DataError


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("import")(import_)


def import_(
    file: Annotated[Path, typer.Argument(help="CSV, .mat, ROS 2 bag, …", show_default=False)],
    map_: Annotated[
        Path, typer.Option("--map", help="YAML that says what the columns are.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="MCAP to write.", show_default=False)],
    format_: Annotated[
        str, typer.Option("--format", help="csv, mat, ros2bag or ur_rtde; overrides the map's.")
    ] = "",
    rows: Annotated[
        str, typer.Option("--rows", help="Rows A:B, counted from 1, both included.")
    ] = "",
    drop_bad_rows: Annotated[
        bool, typer.Option("--drop-bad-rows", help="Leave out rows that make no sense.")
    ] = False,
    payload: Annotated[
        str,
        typer.Option(
            "--payload",
            help="Load that was mounted, MASS_KG or MASS_KG,X_M,Y_M,Z_M; by default the map's.",
        ),
    ] = "",
    json: JsonFlag = False,
) -> None:
    """Import a recording; rows that make no sense are refused with their line numbers."""
    from hil import api

    report = api.import_recording(
        file,
        map_file=map_,
        out=out,
        format_=format_ or None,
        rows=_window(rows),
        drop_bad_rows=drop_bad_rows,
        payload=payload or None,
    )
    if json:
        print_json(report)
        return
    typer.echo(f"{out}: {report['samples']} samples, {report['dropped']} rows dropped")
    for note in report["notes"]:
        typer.echo(f"  {note}")


def _window(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        raise DataError(
            f"--rows {text!r} is no window of rows", hint="for example: --rows 635:3510"
        ) from None
    return first, last
