"""`hil validate`, `hil plan`, `hil schema`: everything before the robot moves."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hil.cli import reidentify, series
from hil.cli.output import (
    JsonFlag,
    SpecPath,
    StationOption,
    duration,
    print_json,
    print_table,
    print_warnings,
    size,
)
from hil.cli.overriding import FirstOption, SetOption, SpeedOption, load_with, refuse_set
from hil.core import SpecError


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(validate)
    app.command()(plan)
    app.command()(schema)


def validate(
    spec: SpecPath,
    station: StationOption = None,
    set_: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """Check a spec, series or schedule and its station; all problems at once, with their places."""
    from hil.core import read_source
    from hil.spec import is_schedule, is_series
    from hil.workflow import check_driver, missing_extras

    source = read_source(spec)
    if is_schedule(source):
        refuse_set(set_, "a schedule")
        reidentify.validate_schedule(source, station, json)
        return
    if is_series(source):
        refuse_set(set_, "a series")
        series.validate_series(source, station, json)
        return

    experiment = load_with(source, station, set_)
    check_driver(experiment)
    facts: dict[str, Any] = {
        "spec": str(spec),
        "name": experiment.spec.name,
        "station": experiment.station_source,
        "valid": True,
        "warnings": missing_extras(experiment.spec),
    }
    if json:
        print_json(facts)
    else:
        typer.echo(
            f"{spec}: valid ({experiment.spec.excitation.kind}, robot {experiment.spec.robot})"
        )
        typer.echo(f"station: {experiment.station_source}")
        print_warnings(facts["warnings"])


def plan(
    spec: SpecPath,
    station: StationOption = None,
    set_: SetOption = None,
    speed: SpeedOption = "",
    first: FirstOption = "",
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Where the picture of the motion goes; by default NAME.plan.svg here.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Also write the plan itself (JSON).")
    ] = None,
    connect: Annotated[
        bool,
        typer.Option(
            "--connect",
            help="Plan from where the robot stands now; without it only a robot on a virtual "
            "clock is asked.",
        ),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Show what `hil run` would do with the same options: steps, ranges, margins; move nothing."""
    _require_svg(picture)
    from hil.cli.progress import ExcitationLine
    from hil.core import json_document, read_source, write_replacing
    from hil.planning import commissioning_of
    from hil.report import plan_picture
    from hil.spec import is_series
    from hil.workflow import check_driver, preview_experiment

    part = commissioning_of(speed, first)
    source = read_source(spec)
    if is_series(source):
        refuse_set(set_, "a series")
        series.plan_series(source, station, part, connect, json)
        return
    experiment = replace(load_with(source, station, set_), commissioning=part)
    check_driver(experiment)
    with ExcitationLine() as line:
        made, facts = preview_experiment(experiment, connect=connect, watch=line)
    shown = facts.to_dict()
    drawn = plan_picture(made, picture or Path(f"{experiment.spec.name}.plan.svg"))
    if out:
        write_replacing(out, json_document(made.to_dict()))
    if json:
        print_json({**shown, "picture": str(drawn)})
        return
    typer.echo(replace(experiment, commissioning=part and part.within(made)).title)
    condition = [("condition number", _figure(shown["condition_number"]))]
    rows = [
        ("waypoints", str(shown["waypoints"])),
        ("steps", str(len(made))),
        ("duration", duration(shown["duration_s"])),
        ("recording", size(shown["recording_bytes"])),
        *facts.swept.narrow_rows(),
        *(condition if part is None else []),  # a commissioning run is not fitted
        *((f"margin: {key}", f"{value:.4g}") for key, value in shown["margins"].items()),
        *(
            (f"interlock: {one['name']}", f"{one['limit']} → {one['action']}")
            for one in shown["interlocks"]
            if one["action"] != "off"
        ),
        ("picture", str(drawn)),
        ("plan hash", shown["hash"][:12]),
    ]
    print_table(("", ""), rows)
    for one in shown["interlocks"]:
        if one["action"] == "off":
            typer.echo(f"interlock {one['name']} is off: {one['why']}")
    print_warnings(shown["warnings"])


def _require_svg(picture: Path | None) -> None:
    """Refuse other formats before the plan is made, which may take a minute."""
    if picture is not None and picture.suffix.lower() != ".svg":
        raise SpecError(
            f"--picture {picture}: the picture of a plan is an SVG file",
            hint=f"--picture {picture.with_suffix('.svg')}",
        )


def _figure(value: float | None) -> str:
    """A condition number; infinite (None) when the motion cannot tell the parameters apart."""
    return "infinite" if value is None else f"{value:.1f}"


def schema(
    kind: Annotated[
        Literal["experiment", "station", "series", "schedule", "map"],
        typer.Argument(help="What kind of file it is of."),
    ] = "experiment",
) -> None:
    """Print the JSON Schema of a spec, station, series, schedule or import map, for editors."""
    if kind == "map":
        from hil.importers import map_schema

        print_json(map_schema())
        return
    from hil.spec import experiment_schema, schedule_schema, series_schema, station_schema

    schemas = {
        "experiment": experiment_schema, "station": station_schema, "series": series_schema,
        "schedule": schedule_schema,
    }  # fmt: skip
    print_json(schemas[kind]())
