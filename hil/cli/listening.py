"""`hil record`: record a robot that hil does not drive."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.output import JsonFlag, RunsOption, StationOption, duration, print_json
from hil.cli.runs import fail
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.workflow import PassiveResult

PROGRAM_STOPS = "program-stops"


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(record)


def record(
    robot: Annotated[str, typer.Option("--robot", help="Its name in the station.")],
    station: StationOption = None,
    until: Annotated[
        str,
        typer.Option(
            "--until", metavar=PROGRAM_STOPS, help="End when the robot's program has stopped."
        ),
    ] = "",
    for_: Annotated[
        str, typer.Option("--for", metavar="DURATION", help="How long, such as 60s or 5min.")
    ] = "",
    payload: Annotated[
        str,
        typer.Option("--payload", help="Load that is mounted, MASS_KG or MASS_KG,X_M,Y_M,Z_M."),
    ] = "",
    name: Annotated[str, typer.Option("--name", help="What to call the recording.")] = "recording",
    runs: RunsOption = Path("runs"),
    operator: Annotated[str, typer.Option("--operator", help="Who is at the robot.")] = "",
    json: JsonFlag = False,
) -> None:
    """Record a robot that somebody else drives; Ctrl-C ends it, too. Nothing is commanded."""
    from hil.arms import parse_payload
    from hil.engine import ignore_from_now_on
    from hil.workflow import RecordingRequest, record_passively

    request = RecordingRequest(
        robot=robot,
        name=name,
        for_s=_seconds(for_),
        until_program_stops=_until(until),
        payload=parse_payload(payload) if payload else None,
        operator=operator,
    )
    found = record_passively(
        request, station=station, runs=runs, tell=lambda line: typer.echo(line, err=True)
    )
    ignore_from_now_on()
    if json:
        print_json(found.to_dict())
    else:
        _tell(found)
    if found.error is not None:
        fail(found.error, json)


def _tell(found: "PassiveResult") -> None:
    steps = ", ".join(f"{kind}: {count}" for kind, count in found.steps.items()) or "nothing"
    typer.echo(f"{found.run}: {found.reason}")
    typer.echo(
        f"  {found.counts.get('samples', 0)} samples in {duration(found.device_s)}, "
        f"{found.counts.get('missing', 0)} missing; found {steps}"
    )
    for note in found.notes:
        typer.echo(f"  {note}")
    if found.steps:
        typer.echo(f"  next: hil report {found.run}")


def _until(text: str) -> bool:
    if text in ("", PROGRAM_STOPS):
        return bool(text)
    raise SpecError(
        f"--until {text!r} is no end of a recording", hint=f"use --until {PROGRAM_STOPS}"
    )


def _seconds(text: str) -> float | None:
    """A duration with its unit; None when nothing is said."""
    from hil.core import UNITS, parse_quantity

    if not text:
        return None
    parsed = parse_quantity(text)
    if parsed is None or UNITS[parsed[1]].dimension != "time" or parsed[0] <= 0:
        raise SpecError(f"--for {text!r} is no duration", hint="for example: --for 60s, --for 5min")
    return parsed[0] * UNITS[parsed[1]].factor
