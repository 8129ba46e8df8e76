"""`hil run` and `hil resume`: move the robot."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hil.cli import live as live_verbs
from hil.cli import series
from hil.cli.attended import Attended, rejected, with_attendance
from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json
from hil.cli.overriding import FirstOption, SetOption, SpeedOption, load_with, refuse_set
from hil.cli.runs import RunArgument, fail, tell_run
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.workflow import RunReport


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(run)
    app.command()(resume)


@with_attendance
def run(
    spec: SpecPath,
    station: StationOption = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
    speed: SpeedOption = "",
    first: FirstOption = "",
    *,
    attended: Attended,
    json: JsonFlag = False,
) -> None:
    """Run an experiment or a series: from plan to report."""
    from hil.core import read_source
    from hil.engine import ignore_from_now_on
    from hil.planning import commissioning_of
    from hil.spec import is_schedule, is_series

    source = read_source(spec)
    if is_schedule(source):
        raise SpecError(
            f"{spec} is a schedule, not an experiment or a series",
            hint=f"run it once, now: hil reidentify {spec}; or whenever it is due: "
            f"hil schedule run {spec}",
        )
    part = commissioning_of(speed, first)
    if is_series(source):
        refuse_set(set_, "a series")
        series.run_series(
            source,
            station,
            runs,
            part,
            lambda each: attended.run(each, runs),
            json,
            confirm=attended.confirm_together,
        )
        return
    experiment = replace(load_with(source, station, set_), commissioning=part)
    if not json:
        typer.echo(experiment.title, err=True)
    report = attended.run(experiment, runs)
    ignore_from_now_on()
    _tell_report(report, json)


@with_attendance
def resume(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    *,
    attended: Attended,
    json: JsonFlag = False,
) -> None:
    """Go on with a run: one that ended early in a new attempt, one that is paused where it is."""
    from hil.core import is_live
    from hil.engine import ignore_from_now_on
    from hil.recording import SeriesGroup
    from hil.runs import find_run

    path = find_run(run, runs)
    if SeriesGroup.is_at(path):
        above = path.parents[2]
        series.resume_series(
            path,
            lambda each: attended.run(each, above),
            attended.resume,
            json,
            confirm=attended.confirm_together,
        )
        return
    if is_live(path):
        live_verbs.let_go_on(path, attended.operator, json)
        return
    report = attended.resume(path)
    ignore_from_now_on()
    _tell_report(report, json)


def _tell_report(report: "RunReport", json: bool) -> None:
    if json:
        print_json(report.to_dict())
    else:
        tell_run(report.run)
    if (error := report.error or rejected(report)) is not None:
        fail(error, json)
