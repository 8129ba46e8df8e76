"""`hil reidentify`: probe a robot once and re-identify it if it has changed."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import (
    REGISTRY,
    JsonFlag,
    RegistryOption,
    RunsOption,
    ScheduleArgument,
    StationOption,
)
from hil.cli.output import ignore_from_now_on, print_errors, print_json, say

app = typer.Typer()


@app.command()
def reidentify(
    schedule: ScheduleArgument,
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    registry: RegistryOption = REGISTRY,
    state: Annotated[
        Path | None,
        typer.Option("--state", help="State folder of the schedule; default: schedules/NAME."),
    ] = None,
    campaign: Annotated[
        bool,
        typer.Option("--campaign", help="Re-identify the robot even if the probe shows no change."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Execute one probe of a schedule now, and re-identify the robot if it has changed.

    Continues an earlier call that was cut off, unless that call began before the schedule's
    `missed_within`.
    """
    from hil import api
    from hil.cli.progress import ProgressLines

    result = api.reidentify(
        schedule,
        station=station,
        runs=runs,
        registry=registry,
        state=state,
        campaign=campaign,
        observers=(ProgressLines(),),
        tell=lambda text: typer.echo(text, err=True),
    )
    ignore_from_now_on()
    if json:
        print_json(result)
        return
    say(f"{result['name']}: {result['text']}")
    if errors := result["errors"]:
        rows = [
            (f"{result['before']} before", errors["before"]),
            (f"{result['champion']} after", errors["after"]),
        ]
        print_errors(f"RMSE [{errors['unit']}]", rows, mean=False)
    for stage, run in result["runs"].items():
        typer.echo(f"{stage}: {run}")
