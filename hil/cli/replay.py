"""`hil replay`: the recording of a run once more, from a log of its bus."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import print_json

app = typer.Typer()


@app.command()
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
    from hil.workflow import replay as replay_log

    result = replay_log(find_run(run, runs), log, runs)
    if json:
        print_json(result.to_dict())
        return
    typer.echo(f"{result.run}: replayed from {log}")
    for name, count in result.counts.items():
        if name == "overruns":  # by the host's clock, of which a log has microseconds only
            continue
        before = result.recorded.get(name)
        beside = "" if before is None else f" (the run itself recorded {before})"
        typer.echo(f"  {name}: {count}{beside}")
    typer.echo(f"  next: hil report {result.run}")
