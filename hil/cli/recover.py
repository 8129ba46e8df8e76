"""`hil recover`: torn recordings become whole ones."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import JsonFlag, RunsOption, print_json
from hil.core import exit_code_of


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(recover)


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
            help="Whole file to write, or folder for those of a run; what is there stays as it is.",
        ),
    ] = None,
    discard: Annotated[
        bool, typer.Option("--discard", help="Delete the torn file once the new one is verified.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Rebuild torn or damaged recordings from all that is whole in them, and say what is lost."""
    from hil.recording import recover as recover_all
    from hil.runs import find_run

    if out is not None and discard:
        raise typer.BadParameter("-o leaves the torn file where it is: without --discard")
    path = Path(source)
    result = recover_all(path if path.is_file() else find_run(source, runs), out, discard=discard)
    if json:
        print_json(result.to_dict())
    else:
        for file in result.files:
            typer.echo("\n".join(file.to_lines()))
        if not (result.files or result.problems):
            typer.echo(f"{result.source} has no torn or damaged recording")
    if (error := result.error) is not None:
        if not json:
            raise error
        typer.echo(f"{type(error).__name__}: {error}", err=True)
        raise typer.Exit(exit_code_of(error))
