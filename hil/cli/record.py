"""`hil record`: record a robot that a different program drives."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import (
    JsonFlag,
    OperatorOption,
    RunsOption,
    StationOption,
    parse_duration,
)
from hil.cli.output import fail, ignore_from_now_on, print_json
from hil.core import SpecError
from hil.report import duration

PROGRAM_STOPS = "program-stops"

app = typer.Typer()


@app.command()
def record(
    robot: Annotated[str, typer.Option("--robot", help="Name of the robot in the station.")],
    station: StationOption = None,
    until: Annotated[
        str,
        typer.Option(
            "--until", metavar=PROGRAM_STOPS, help="End the recording when the robot program stops."
        ),
    ] = "",
    for_: Annotated[
        str,
        typer.Option(
            "--for", metavar="DURATION", help="Duration of the recording, such as 60s or 5min."
        ),
    ] = "",
    payload: Annotated[
        str,
        typer.Option("--payload", help="Mounted payload: MASS_KG or MASS_KG,X_M,Y_M,Z_M."),
    ] = "",
    name: Annotated[str, typer.Option("--name", help="Name of the recording.")] = "recording",
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    json: JsonFlag = False,
) -> None:
    """Record a robot that another program drives, until Ctrl-C; send no commands."""
    from hil.arms import parse_payload
    from hil.workflow import RecordingRequest, record_passively

    if until not in ("", PROGRAM_STOPS):
        raise SpecError(
            f"--until {until!r} is not an end condition", hint=f"use --until {PROGRAM_STOPS}"
        )
    for_s = parse_duration("--for", for_, "--for 60s, --for 5min").total_seconds() if for_ else None
    if for_s == 0.0:
        raise SpecError(f"--for {for_} is not a positive duration", hint="for example: --for 60s")
    request = RecordingRequest(
        robot=robot,
        name=name,
        for_s=for_s,
        until_program_stops=bool(until),
        payload=parse_payload(payload) if payload else None,
        operator=operator,
    )
    result = record_passively(
        request, station=station, runs=runs, tell=lambda line: typer.echo(line, err=True)
    )
    ignore_from_now_on()
    if json:
        print_json(result.to_dict())
    else:
        steps = ", ".join(f"{kind}: {count}" for kind, count in result.steps.items())
        typer.echo(f"{result.run}: {result.reason}")
        typer.echo(
            f"  {result.counts.get('samples', 0)} samples in {duration(result.device_s)}, "
            f"{result.counts.get('missing', 0)} missing; detected {steps or 'nothing'}"
        )
        for note in result.notes:
            typer.echo(f"  {note}")
        if result.steps:
            typer.echo(f"  next: hil report {result.run}")
    if result.error is not None:
        fail(result.error, json)
