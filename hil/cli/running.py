"""`hil run` and `hil resume`: move the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli import live as live_verbs
from hil.cli import reidentify, series
from hil.cli.attended import Attended, rejected
from hil.cli.live_view import LiveFlag, LiveHost, LivePort
from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json
from hil.cli.overriding import FirstOption, SetOption, SpeedOption, load_with, refuse_set
from hil.cli.registry import HERE, RegistryOption
from hil.cli.runs import RunArgument, fail, tell_run
from hil.cli.simulating import SimulateOption, simulate_schedule
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.workflow import RunReport

OperatorOption = Annotated[str, typer.Option("--operator", help="Who is at the robot; recorded.")]
WaiveOption = Annotated[
    list[str] | None,
    typer.Option(
        "--waive", metavar="NAME=REASON", help="Accept a failed preflight check; recorded."
    ),
]
AnswersOption = Annotated[
    Path | None,
    typer.Option("--answers", help="Answers to all prompts (YAML), for runs nobody attends."),
]
ElsewhereFlag = Annotated[
    bool,
    typer.Option(
        "--elsewhere",
        help="Nobody sits at this console: prompts, also those of a mock, wait for `hil answer` or "
        "the dashboard.",
    ),
]
WaitOption = Annotated[
    float,
    typer.Option(
        "--wait",
        min=0,
        metavar="SECONDS",
        help="How long to wait for a robot that somebody else holds.",
    ),
]
YesFlag = Annotated[
    bool,
    typer.Option(
        "--yes",
        help="Move a real robot without a prompt (for scripts). The confirmation is recorded in "
        "the run.",
    ),
]
ConfirmedOption = Annotated[
    Path | None,
    typer.Option(
        "--confirmed",
        metavar="FILE",
        help="JSON file with the confirmed facts of the motion, as written by the dashboard; a "
        "real robot moves only if they cover this run.",
    ),
]
CampaignFlag = Annotated[
    bool,
    typer.Option("--campaign", help="A schedule: identify it again, whatever its probe says."),
]
StateOption = Annotated[
    Path | None,
    typer.Option("--state", help="A schedule: where its state is; by default schedules/NAME."),
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(run)
    app.command()(resume)


def run(
    spec: SpecPath,
    station: StationOption = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    answers: AnswersOption = None,
    elsewhere: ElsewhereFlag = False,
    waive: WaiveOption = None,
    wait: WaitOption = 0.0,
    yes: YesFlag = False,
    confirmed: ConfirmedOption = None,
    speed: SpeedOption = "",
    first: FirstOption = "",
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    campaign: CampaignFlag = False,
    registry: RegistryOption = HERE,
    state: StateOption = None,
    simulate: SimulateOption = "",
    json: JsonFlag = False,
) -> None:
    """Run an experiment, a series, or once what a schedule is about: from plan to report."""
    from hil.core import read_source
    from hil.engine import ignore_from_now_on
    from hil.planning import commissioning_of
    from hil.spec import is_schedule, is_series

    source = read_source(spec)
    if is_schedule(source):
        refuse_set(set_, "a schedule")
        _refuse_attended(
            operator, answers, elsewhere, waive, wait, yes, confirmed, speed, first, live
        )
        if simulate:
            _refuse_kept(campaign, state, registry != HERE)
            simulate_schedule(spec, station, runs, simulate, json=json)
            return
        reidentify.run_schedule(spec, station, runs, registry, state, campaign=campaign, json=json)
        return
    if simulate:
        raise SpecError(
            f"{spec} is no schedule: there are no weeks to --simulate",
            hint="name a schedule (hil_schedule: …), or leave --simulate out",
        )
    part = commissioning_of(speed, first)
    views = (live, live_port, live_host)
    attended = Attended(
        operator, answers, tuple(waive or ()), wait, views, elsewhere, yes, confirmed
    )

    if is_series(source):
        refuse_set(set_, "a series")
        series.run_series(
            spec,
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


def _refuse_attended(*given: object) -> None:
    """Nobody attends a schedule: what is for attended runs would be left out without a word."""
    if any(given):
        raise SpecError(
            "--operator, --answers, --elsewhere, --waive, --wait, --yes, --confirmed, --speed, "
            "--first and --live are for attended runs, not for schedules",
            hint="run its experiments by themselves to try them",
        )


def _refuse_kept(*given: object) -> None:
    """A simulation touches no registry or state but its own, and does what is due."""
    if any(given):
        raise SpecError(
            "--campaign, --registry and --state do not go with --simulate",
            hint="a simulation has a registry and a state of its own, in its folder",
        )


def resume(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    answers: AnswersOption = None,
    elsewhere: ElsewhereFlag = False,
    waive: WaiveOption = None,
    wait: WaitOption = 0.0,
    yes: YesFlag = False,
    confirmed: ConfirmedOption = None,
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    json: JsonFlag = False,
) -> None:
    """Go on with a run: one that ended early in a new attempt, one that is paused where it is."""
    from hil.core import is_live
    from hil.engine import ignore_from_now_on
    from hil.runs import find_run, is_series_folder

    path = find_run(run, runs)
    views = (live, live_port, live_host)
    attended = Attended(
        operator, answers, tuple(waive or ()), wait, views, elsewhere, yes, confirmed
    )
    if is_series_folder(path):
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
        live_verbs.let_go_on(path, operator, json)
        return
    report = attended.resume(path)
    ignore_from_now_on()
    _tell_report(report, json)


def _tell_report(report: RunReport, json: bool) -> None:
    if json:
        print_json(report.to_dict())
    else:
        tell_run(report.run)
    if (error := report.error or rejected(report)) is not None:
        fail(error, json)
