"""Verbs given a schedule: `hil run` does what it is about once, now; `hil validate` checks it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from hil.cli.output import print_json, print_table, print_warnings, say


def validate_schedule(path: Path, station: Path | None, json: bool) -> None:
    """Check a schedule with everything it names; all problems at once."""
    from hil.maintenance import bind_file
    from hil.workflow import missing_extras

    bound = bind_file(path, station)
    missing = dict.fromkeys(told for one in bound.experiments for told in missing_extras(one.spec))
    told = {
        "schedule": str(path),
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
    typer.echo(f"{path}: valid (models of {bound.name}, {bound.fit.estimator})")
    for each in bound.experiments:
        typer.echo(f"  {each.title}")
    print_warnings(missing)


def run_schedule(
    path: Path,
    station: Path | None,
    runs: Path,
    registry: Path,
    state: Path | None,
    *,
    campaign: bool,
    json: bool,
) -> None:
    """Do once and now what a schedule is about; goes on with what was cut off not too long ago.

    Args:
        path: Its file.
        station: In place of the one it names.
        runs: Where run directories are kept.
        registry: Where models are.
        state: Of the schedule; by default `schedules/NAME`.
        campaign: Whether the full program is run whatever the probe says.
        json: Whether to print one document and nothing else.

    Raises:
        DataError: Another process does the same now.
    """
    from hil import api
    from hil.cli.progress import ProgressLines
    from hil.engine import ignore_from_now_on

    told = api.reidentify(
        path, station=station, runs=runs, registry=registry, state=state, campaign=campaign,
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
