"""`hil replay`: recreate the recording of a run from a log of its bus."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import print_json

app = typer.Typer()


@app.command()
def replay(
    run: Annotated[
        str,
        typer.Argument(help="Run directory, run number or experiment name.", show_default=False),
    ],
    log: Annotated[
        Path,
        typer.Argument(
            help="Log of the CAN bus in the format of `candump -L`.", show_default=False
        ),
    ],
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Recreate the recording of a run from a CAN bus log, in a new run directory."""
    from hil.runs import find_run
    from hil.workflow import replay as replay_log

    result = replay_log(find_run(run, runs), log, runs)
    if json:
        print_json(result.to_dict())
        return
    typer.echo(f"{result.run}: replayed from {log}")
    for name, count in result.counts.items():
        if name == "overruns":  # by the host's clock; a log has only microseconds
            continue
        before = result.recorded.get(name)
        beside = "" if before is None else f" (recorded by the run: {before})"
        typer.echo(f"  {name}: {count}{beside}")
    typer.echo(f"  next: hil report {result.run}")
