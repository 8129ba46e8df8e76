"""`hil plan`: show the plan of a run without moving the robot."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.options import (
    FirstOption,
    JsonFlag,
    SetOption,
    SpecArgument,
    SpeedOption,
    StationOption,
    load_experiment,
    refuse_set,
)
from hil.cli.output import print_json, print_table, print_warnings, say
from hil.core import SpecError
from hil.report import duration, size

if TYPE_CHECKING:
    from hil.core import Source
    from hil.planning import Commissioning, Experiment, Plan, PlanPreview

app = typer.Typer()


@app.command()
def plan(
    spec: SpecArgument,
    station: StationOption = None,
    set_: SetOption = None,
    speed: SpeedOption = "",
    first: FirstOption = "",
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="SVG file for the drawing of the motion; default: NAME.plan.svg in the current "
            "folder.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Also write the plan to this JSON file.")
    ] = None,
    connect: Annotated[
        bool,
        typer.Option(
            "--connect",
            help="Connect to the robot and plan from its current pose. Robots on a virtual clock "
            "are always connected.",
        ),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Show the plan of a run without moving: joint ranges, margins to limits, duration."""
    _require_svg(picture)
    from hil.core import json_document, read_source, write_replacing
    from hil.planning import commissioning_of
    from hil.report import plan_picture
    from hil.spec import is_series
    from hil.workflow import check_driver

    part = commissioning_of(speed, first)
    source = read_source(spec)
    if is_series(source):
        refuse_set(set_, "a series")
        _plan_series(source, station, part, connect, json)
        return
    experiment = replace(load_experiment(source, station, set_), commissioning=part)
    check_driver(experiment)
    made, preview = _preview(experiment, connect)
    drawing = plan_picture(made, picture or Path(f"{experiment.spec.name}.plan.svg"))
    if out:
        write_replacing(out, json_document(made.to_dict()))
    facts = {**preview.to_dict(), "picture": str(drawing)}
    if json:
        print_json(facts)
        return
    typer.echo(replace(experiment, commissioning=part and part.within(made)).title)
    # A commissioning run is not fitted.
    conditions = [("condition number", _condition(facts))] if part is None else []
    rows = [
        ("waypoints", str(facts["waypoints"])),
        ("steps", str(len(made))),
        ("duration", duration(facts["duration_s"])),
        ("recording", size(facts["recording_bytes"])),
        *preview.swept.narrow_rows(),
        *conditions,
        *((f"margin: {key}", f"{value:.4g}") for key, value in facts["margins"].items()),
        *(
            (f"interlock: {one['name']}", f"{one['limit']} → {one['action']}")
            for one in facts["interlocks"]
            if one["action"] != "off"
        ),
        ("picture", facts["picture"]),
        ("plan hash", facts["hash"][:12]),
    ]
    print_table(("", ""), rows)
    for one in facts["interlocks"]:
        if one["action"] == "off":
            say(f"interlock {one['name']} is off: {one['why']}")
    print_warnings(facts["warnings"])


def _require_svg(picture: Path | None) -> None:
    """Raise for picture formats other than SVG before planning, which may take a minute."""
    if picture is not None and picture.suffix.lower() != ".svg":
        raise SpecError(
            f"--picture {picture}: the picture must be an SVG file",
            hint=f"--picture {picture.with_suffix('.svg')}",
        )


def _preview(experiment: "Experiment", connect: bool) -> "tuple[Plan, PlanPreview]":
    from hil.cli.progress import ExcitationLine
    from hil.workflow import preview_experiment

    with ExcitationLine() as line:
        return preview_experiment(experiment, connect=connect, watch=line)


def _condition(facts: Mapping[str, Any]) -> str:
    """Return the condition number; "infinite" if the motion does not determine all parameters."""
    value = facts["condition_number"]
    return "infinite" if value is None else f"{value:.1f}"


def _plan_series(
    source: "Source", station: Path | None, part: "Commissioning | None", connect: bool, json: bool
) -> None:
    """Print the plan of each experiment of a series, and the total duration."""
    from hil.workflow import load_series

    experiments = load_series(source, station).experiments
    previews = [
        _preview(replace(each, commissioning=part), connect)[1].to_dict() for each in experiments
    ]
    total = {
        key: sum(facts[key] for facts in previews) for key in ("duration_s", "recording_bytes")
    }
    if json:
        runs = [
            {"name": each.spec.name, **facts}
            for each, facts in zip(experiments, previews, strict=True)
        ]
        print_json({"series": source.name, "runs": runs, **total})
        return
    rows = [
        (each.spec.name, each.spec.robot, *_amounts(facts))
        for each, facts in zip(experiments, previews, strict=True)
    ]
    rows.append(("total", "", *_amounts(total)))
    print_table(("experiment", "robot", "motion", "recording"), rows)
    typer.echo(f"durations of motion only; for margins: hil plan {experiments[0].spec_source}")
    for each, facts in zip(experiments, previews, strict=True):
        print_warnings(f"{each.spec.name}: {warning}" for warning in facts["warnings"])


def _amounts(facts: Mapping[str, Any]) -> tuple[str, str]:
    return duration(facts["duration_s"]), size(facts["recording_bytes"])
