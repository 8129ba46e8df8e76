"""Verbs given a schedule: `hil run` does what it is about once, now; `hil validate` checks it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hil.cli.output import print_json, print_table, print_warnings, say
from hil.cli.schedule import STATES

if TYPE_CHECKING:
    from hil.schedule.occasion import Job, Occasion

BY_HAND = "by-hand"
"""Below the schedule's state: occasions that somebody asked for."""


def validate_schedule(path: Path, station: Path | None, json: bool) -> None:
    """Check a schedule with everything it names; all problems at once."""
    from hil.campaign.extras import missing_extras
    from hil.pipeline.bound import bind_file

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
    from hil.campaign.extras import require_extras
    from hil.cli.progress import ProgressLines
    from hil.engine.signals import ignore_from_now_on
    from hil.pipeline.bound import bind_file
    from hil.pipeline.reidentify import reidentification
    from hil.registry.registry import Registry
    from hil.schedule.ledger import kept

    bound = bind_file(path, station)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    job: Job = "campaign" if campaign or bound.probe is None else "probe"
    home = (state or STATES / bound.spec.name) / BY_HAND
    work = reidentification(
        bound.spec, registry=Registry(registry), runs=runs, station=station,
        observers=(ProgressLines(),), tell=lambda stage: typer.echo(f"stage: {stage}", err=True),
    )  # fmt: skip
    with kept(home, bound.spec.name):
        occasion = _left(home, job, bound.spec.missed_within) or _now(job)
        told = dict(work(occasion, home / occasion.id)) | {"folder": str(home / occasion.id)}
    ignore_from_now_on()
    if json:
        print_json(told)
    else:
        _tell(told)


def _now(job: Job) -> Occasion:
    from hil.schedule.occasion import Occasion

    return Occasion(datetime.now(UTC).replace(microsecond=0), job)


def _left(home: Path, job: Job, within: timedelta) -> Occasion | None:
    """The newest occasion of that kind, if it was cut off; days later the robot is another one."""
    from hil.pipeline.stages import kept_document
    from hil.schedule.ledger import occasion_of

    for folder in sorted(home.glob(f"*-{job}"), reverse=True)[:1]:
        left = occasion_of(folder.name)
        if kept_document(folder, "summary") is None and left.due >= datetime.now(UTC) - within:
            say(f"going on with {folder}")
            return left
    return None


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
