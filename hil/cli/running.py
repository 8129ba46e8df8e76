"""`hil run` and `hil resume`: move the robot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli import live as live_verbs
from hil.cli.live_view import LiveFlag, LiveHost, LivePort, live_view, recorded_capabilities
from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json
from hil.cli.runs import RunArgument, fail, tell_run
from hil.errors import Rejected, SpecError

if TYPE_CHECKING:
    from hil.campaign.run import RunReport

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
WaitOption = Annotated[
    float,
    typer.Option(
        "--wait",
        min=0,
        metavar="SECONDS",
        help="How long to wait for a robot that somebody else holds.",
    ),
]
SpeedOption = Annotated[
    str,
    typer.Option(
        "--speed",
        metavar="SHARE",
        help="Commissioning: the same plan slower, such as 10%; neither fitted nor judged.",
    ),
]
FirstOption = Annotated[
    str,
    typer.Option(
        "--first",
        metavar="N|SECONDSs",
        help="Commissioning: only the first poses or trajectories (10), or seconds (30s).",
    ),
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(run)
    app.command()(resume)


def run(
    spec: SpecPath,
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    answers: AnswersOption = None,
    waive: WaiveOption = None,
    wait: WaitOption = 0.0,
    speed: SpeedOption = "",
    first: FirstOption = "",
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    json: JsonFlag = False,
) -> None:
    """Run an experiment: plan, preflight, motion, recording, fit, validation, report."""
    from hil import api
    from hil.campaign.desk import console_desk
    from hil.campaign.driver_check import check_driver
    from hil.cli.progress import ProgressLines
    from hil.engine.signals import ignore_from_now_on
    from hil.plan.commissioning import commissioning_of

    part = commissioning_of(speed, first)
    experiment = replace(api.load(spec, station), commissioning=part)
    desk = console_desk(operator, answers=answers, wait_s=wait)
    robot = check_driver(experiment)
    if not json:
        typer.echo(experiment.title, err=True)
    with live_view(lambda: robot, live, live_port, live_host) as views:
        report = api.run(
            experiment,
            runs=runs,
            operator=operator,
            observers=(ProgressLines(), *views),
            waivers=_waivers(waive or ()),
            desk=desk,
        )
    ignore_from_now_on()
    _tell_report(report, json)


def resume(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    answers: AnswersOption = None,
    waive: WaiveOption = None,
    wait: WaitOption = 0.0,
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    json: JsonFlag = False,
) -> None:
    """Go on with a run: one that ended early in a new attempt, one that is paused where it is."""
    from hil import api
    from hil.campaign.desk import console_desk
    from hil.cli.progress import ProgressLines
    from hil.engine.signals import ignore_from_now_on
    from hil.record.catalogue import find_run
    from hil.record.lock import is_live

    path = find_run(run, runs)
    if is_live(path):
        live_verbs.let_go_on(path, operator, json)
        return
    desk = console_desk(operator, answers=answers, wait_s=wait)
    with live_view(lambda: recorded_capabilities(path), live, live_port, live_host) as views:
        report = api.resume(
            path,
            operator=operator,
            observers=(ProgressLines(), *views),
            waivers=_waivers(waive or ()),
            desk=desk,
        )
    ignore_from_now_on()
    _tell_report(report, json)


def _tell_report(report: RunReport, json: bool) -> None:
    if json:
        print_json(report.to_dict())
    else:
        tell_run(report.run)
    if report.error is not None:
        fail(report.error, json)
    if report.verdict == "rejected":
        missed = f"the model of {report.run} missed its acceptance criteria"
        fail(Rejected(missed, hint=f"hil show {report.run}"), json)


def _waivers(texts: Iterable[str]) -> dict[str, str]:
    """`NAME=REASON` texts to a dict; a waiver without a reason is none."""
    pairs = [text.partition("=") for text in texts]
    for name, _, reason in pairs:
        if not (name and reason.strip()):
            raise SpecError(
                f"--waive {name!r} gives no reason",
                hint='for example: --waive "disk=the recording is short"',
            )
    return {name: reason.strip() for name, _, reason in pairs}
