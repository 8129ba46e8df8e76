"""`hil doctor` and `hil plugins`: what this computer and this installation have, and what not."""

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
        typer.Option("--station", help="Also ask the robots of this station; none is moved."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Look at this computer, and with --station at its robots; exits 1 when something is bad."""
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
    """List drivers, estimators, excitations, checks, interlocks and mocks; broken ones and why."""
    from hil.core import describe_all

    described = describe_all()
    if json:
        print_json([dataclasses.asdict(one) for one in described])
        return
    rows = [(one.group, one.name, one.distribution, one.error or "ok") for one in described]
    print_table(("group", "name", "from", "state"), rows)
