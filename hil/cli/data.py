"""`hil import` and `hil export-data`: recordings from other tools, and for them."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import print_json, say
from hil.core import DataError

app = typer.Typer()


@app.command("import")
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
        say(f"  {note}")


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


@app.command("export-data")
def export_data(
    source: Annotated[
        str,
        typer.Argument(help="Run (directory, name or number) or MCAP file.", show_default=False),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", help="File to make: .parquet, .csv or .npz.", show_default=False
        ),
    ],
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Write the samples of a run for other programs, one row each, nothing rounded."""
    from hil import api
    from hil.runs import find_source

    path = find_source(source, runs)
    export = api.export_data(path, out)
    if json:
        print_json({"source": str(path), **export})
        return
    typer.echo(f"{out}: {export['samples']} samples of {export['series']} series")
    for file in export["files"][1:]:
        typer.echo(f"  {file}")
    for note in export["notes"]:
        say(f"  note: {note}")
