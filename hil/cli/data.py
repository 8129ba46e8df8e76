"""`hil import` and `hil export-data`: recordings from other programs and for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import print_json, say
from hil.core import DataError

app = typer.Typer()


@app.command("import")
def import_(
    file: Annotated[
        Path,
        typer.Argument(help="Recording to import: CSV, .mat, ROS 2 bag, …", show_default=False),
    ],
    map_: Annotated[
        Path,
        typer.Option(
            "--map", help="YAML map of the columns to quantities and units.", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="MCAP file to write.", show_default=False)
    ],
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="Input format: csv, mat, ros2bag or ur_rtde; default: the format in the map.",
        ),
    ] = "",
    rows: Annotated[
        str, typer.Option("--rows", help="First and last row A:B, counted from 1, both included.")
    ] = "",
    drop_bad_rows: Annotated[
        bool, typer.Option("--drop-bad-rows", help="Skip invalid rows.")
    ] = False,
    payload: Annotated[
        str,
        typer.Option(
            "--payload",
            help="Mounted payload: MASS_KG or MASS_KG,X_M,Y_M,Z_M; default: the payload in the "
            "map.",
        ),
    ] = "",
    json: JsonFlag = False,
) -> None:
    """Import a recording of another program (CSV, .mat, ROS 2 bag) as MCAP; report invalid rows."""
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
            f"--rows {text!r} is not a range of rows", hint="for example: --rows 635:3510"
        ) from None
    return first, last


@app.command("export-data")
def export_data(
    source: Annotated[
        str,
        typer.Argument(help="Run (directory, number or name) or MCAP file.", show_default=False),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", help="File to write: .parquet, .csv or .npz.", show_default=False
        ),
    ],
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Export the samples of a run as Parquet, CSV or NPZ, with full precision."""
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
