"""`hil run`, `hil runs`, `hil show`: move the robot, and look at what came of it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.live_view import LiveFlag, LiveHost, LivePort, live_view, recorded_capabilities
from hil.cli.output import (
    JsonFlag,
    RunsOption,
    SpecPath,
    StationOption,
    duration,
    print_json,
    print_table,
)
from hil.errors import DataError, HilError, PreflightFailed, Rejected, exit_code_of

if TYPE_CHECKING:
    from hil.campaign.run import RunReport

RunArgument = Annotated[
    str,
    typer.Argument(help="Run directory, or the number or name of a run.", show_default=False),
]
WaiveOption = Annotated[
    list[str] | None,
    typer.Option(
        "--waive", metavar="NAME=REASON", help="Accept a failed preflight check; recorded."
    ),
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(run)
    app.command()(resume)
    app.command()(runs)
    app.command()(show)


def run(
    spec: SpecPath,
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    operator: Annotated[str, typer.Option(help="Who is at the robot; recorded.")] = "",
    waive: WaiveOption = None,
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    json: JsonFlag = False,
) -> None:
    """Run an experiment: plan, preflight, motion, recording, fit, validation, report."""
    from hil import api
    from hil.campaign.driver_check import check_driver
    from hil.cli.progress import ProgressLines
    from hil.engine.signals import ignore_from_now_on

    experiment = api.load(spec, station)
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
        )
    ignore_from_now_on()
    _tell_report(report, json)


def resume(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    operator: Annotated[str, typer.Option(help="Who is at the robot; recorded.")] = "",
    waive: WaiveOption = None,
    live: LiveFlag = False,
    live_port: LivePort = None,
    live_host: LiveHost = None,
    json: JsonFlag = False,
) -> None:
    """Go on with a run: one that ended early in a new attempt, one that is paused where it is."""
    from hil import api
    from hil.cli.progress import ProgressLines
    from hil.engine.signals import ignore_from_now_on
    from hil.record.catalogue import find_run

    path = find_run(run, runs)
    with live_view(lambda: recorded_capabilities(path), live, live_port, live_host) as views:
        report = api.resume(
            path,
            operator=operator,
            observers=(ProgressLines(), *views),
            waivers=_waivers(waive or ()),
        )
    ignore_from_now_on()
    _tell_report(report, json)


def _tell_report(report: RunReport, json: bool) -> None:
    if json:
        print_json(report.to_dict())
    else:
        _tell(report.run)
    if report.error is not None:
        _fail(report.error, json)
    if report.verdict == "rejected":
        missed = f"the model of {report.run} missed its acceptance criteria"
        _fail(Rejected(missed, hint=f"hil show {report.run}"), json)


def _waivers(texts: Iterable[str]) -> dict[str, str]:
    """`NAME=REASON` texts to a dict; a waiver without a reason is none."""
    pairs = [text.partition("=") for text in texts]
    for name, _, reason in pairs:
        if not (name and reason.strip()):
            raise PreflightFailed(
                f"--waive {name!r} gives no reason",
                hint='for example: --waive "disk=the recording is short"',
            )
    return {name: reason.strip() for name, _, reason in pairs}


def _fail(error: HilError, json: bool) -> None:
    """The JSON document is out already: only the exit code and a line on stderr remain."""
    if not json:
        raise error
    typer.echo(f"{type(error).__name__}: {error}", err=True)
    raise typer.Exit(exit_code_of(error))


def _tell(run: Path) -> None:
    from hil.report.text import summary_lines

    for line in summary_lines(run, max(40, min(80, get_terminal_size().columns))):
        typer.echo(line)


def runs(runs: RunsOption = Path("runs"), json: JsonFlag = False) -> None:
    """List run directories, newest last; interrupted and damaged ones too."""
    from hil.campaign.view import list_runs

    entries = list_runs(runs)
    if json:
        print_json(entries)
    elif not entries:
        typer.echo(f"no runs under {runs}; make one with: hil run SPEC")
    else:
        header = ("run", "status", "duration", "verdict")
        print_table(
            header,
            [
                (e["run"], e["status"], duration(e["duration_s"] or 0.0), e["verdict"])
                for e in entries
            ],
        )


def show(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    verify: Annotated[
        bool, typer.Option("--verify", help="Also compare every file with its checksum.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Show one run: what it was, how it ended, what its models are worth."""
    from hil import api
    from hil.record.catalogue import find_run
    from hil.record.rundir import RunDirectory

    path = find_run(run, runs)
    problems = RunDirectory.open(path).verify() if verify else []
    if json:
        print_json(api.describe_run(path) | ({"problems": problems} if verify else {}))
    else:
        _tell(path)
    if problems:
        hint = "take the run from a copy that is whole, or use what is left of it with care"
        _fail(DataError(f"{path}: {'; '.join(problems)}", hint=hint), json)
    if verify and not json:
        typer.echo("every file is as the run left it")
