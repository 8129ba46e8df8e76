"""`hil recover`: repair truncated or damaged recordings."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import fail, print_json

app = typer.Typer()


@app.command()
def recover(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RUN|FILE",
            help="Run (directory, number or name) or an MCAP file of any writer.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Repaired file, or folder for the repaired files of a run. Existing files are "
            "never overwritten.",
        ),
    ] = None,
    discard: Annotated[
        bool,
        typer.Option(
            "--discard", help="Delete the damaged file after the repaired file has been verified."
        ),
    ] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Repair truncated or damaged recordings and list the lost data."""
    from hil.recording import recover as rebuild
    from hil.runs import find_run

    if out is not None and discard:
        raise typer.BadParameter("--discard cannot be combined with -o, which keeps the file")
    path = Path(source)
    result = rebuild(path if path.is_file() else find_run(source, runs), out, discard=discard)
    if json:
        print_json(result.to_dict())
    else:
        for file in result.files:
            typer.echo("\n".join(file.to_lines()))
        if not (result.files or result.problems):
            typer.echo(f"{result.source} has no truncated or damaged recording")
    if result.error is not None:
        fail(result.error, json)
