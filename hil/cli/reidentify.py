"""`hil reidentify`: probe a robot once, now, and identify it again if it has changed."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.output import (
    JsonFlag,
    RunsOption,
    StationOption,
    print_json,
    print_table,
    print_warnings,
    say,
)
from hil.cli.registry import HERE, RegistryOption

if TYPE_CHECKING:
    from hil.core import Source


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(reidentify)


def validate_schedule(source: "Source", station: Path | None, json: bool) -> None:
    """Check a schedule with everything it names; all problems at once."""
    from hil.maintenance import bind_file
    from hil.workflow import missing_extras

    bound = bind_file(source, station)
    missing = dict.fromkeys(told for one in bound.experiments for told in missing_extras(one.spec))
    told = {
        "schedule": source.name,
        "name": bound.spec.name,
        "model": bound.name,
        "estimator": bound.fit.estimator,
        "runs": [
            {"spec": each.spec_source, "name": each.spec.name, "station": each.station_source}
            for each in bound.experiments
        ],
        "valid": True,
        "warnings": list(missing),
    }
    if json:
        print_json(told)
        return
    typer.echo(f"{source.name}: valid (models of {bound.name}, {bound.fit.estimator})")
    for each in bound.experiments:
        typer.echo(f"  {each.title}")
    print_warnings(missing)


def reidentify(
    schedule: Annotated[Path, typer.Argument(help="Schedule (YAML).", show_default=False)],
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    registry: RegistryOption = HERE,
    state: Annotated[
        Path | None,
        typer.Option("--state", help="Folder of its state; by default schedules/NAME."),
    ] = None,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Identify it again whatever its probe says.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Probe a robot once, now, and identify it again if it has changed, as a schedule says.

    Continues an earlier call that was cut off, unless it began before the schedule's
    `missed_within`.
    """
    from hil import api
    from hil.cli.progress import ProgressLines
    from hil.engine import ignore_from_now_on

    told = api.reidentify(
        schedule, station=station, runs=runs, registry=registry, state=state, campaign=campaign,
        observers=(ProgressLines(),), tell=lambda text: typer.echo(text, err=True),
    )  # fmt: skip
    ignore_from_now_on()
    if json:
        print_json(told)
    else:
        _tell(told)


def _tell(told: dict[str, Any]) -> None:
    say(f"{told['name']}: {told['text']}")
    if errors := told["errors"]:
        joints = [f"J{j + 1}" for j in range(len(errors["joint_names"]))]
        rows = [
            (label, *(f"{value:.4f}" for value in errors[key]))
            for label, key in ((f"{told['before']} before", "before"),
                               (f"{told['champion']} after", "after"))
        ]  # fmt: skip
        print_table((f"RMSE [{errors['unit']}]", *joints), rows)
    for stage, run in told["runs"].items():
        typer.echo(f"{stage}: {run}")
