"""`hil replay`: a run once more, from a log of its bus."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import JsonFlag, RunsOption, print_json


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(replay)


def replay(
    run: Annotated[str, typer.Argument(help="Run directory, number or name.", show_default=False)],
    log: Annotated[
        Path,
        typer.Argument(help="Log of its bus, for CAN as candump -L writes it.", show_default=False),
    ],
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Make the recording of a run anew from a log of its bus, in a run directory of its own."""
    from hil.runs import find_run
    from hil.workflow import replay as replayed_from

    found = replayed_from(find_run(run, runs), log, runs)
    if json:
        print_json(found.to_dict())
        return
    typer.echo(f"{found.run}: replayed from {log}")
    for name, count in found.counts.items():
        if name == "overruns":  # by the host's clock, of which a log tells microseconds only
            continue
        recorded = found.recorded.get(name)
        told = "" if recorded is None else f" (the run itself recorded {recorded})"
        typer.echo(f"  {name}: {count}{told}")
    typer.echo(f"  next: hil report {found.run}")
