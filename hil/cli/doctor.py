"""`hil doctor` and `hil plugins`: checks of this computer, and the installed plug-ins."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import print_json, print_table

app = typer.Typer()


@app.command()
def doctor(
    station: Annotated[
        Path | None,
        typer.Option("--station", help="Also query the robots of this station; no robot moves."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Check this computer and, with --station, its robots. The exit code is 1 if a check fails."""
    from hil.doctor import examine

    findings = examine(station)
    if json:
        print_json([f.to_dict() for f in findings])
    else:
        print_table(("", "what", "finding"), [(f.mark, f.what, f.finding) for f in findings])
    if any(f.bad for f in findings):
        raise typer.Exit(1)


@app.command()
def plugins(json: JsonFlag = False) -> None:
    """List drivers, estimators, checks, interlocks and mocks, with errors of broken plug-ins."""
    from hil.core import describe_all

    described = describe_all()
    if json:
        print_json([dataclasses.asdict(one) for one in described])
        return
    rows = [(one.group, one.name, one.distribution, one.error or "ok") for one in described]
    print_table(("group", "name", "from", "state"), rows)
