"""A series of experiments in `hil run` and `hil resume`.

Each experiment of a series is an ordinary run; the real robots of all are confirmed at once, before
the first. A series that ended early goes on with the run in which it did.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hil.cli.output import fail, ignore_from_now_on, print_json, print_run, print_table
from hil.core import HilError, Rejected

if TYPE_CHECKING:
    from hil.core import Source
    from hil.planning import Commissioning, Experiment
    from hil.recording import SeriesGroup
    from hil.workflow import Moves, RunReport, Series, SeriesReport

Document = dict[str, Any]
Outcome = tuple[Document, HilError | None]
Execute = Callable[["Experiment", Document], Outcome]
Begin = Callable[["Experiment"], "RunReport"]
Resume = Callable[[Path], "RunReport"]


def run_series(
    source: Source,
    station: Path | None,
    runs: Path,
    part: Commissioning | None,
    begin: Begin,
    json: bool,
    *,
    confirm: Callable[[Moves], object],
) -> None:
    """Run a series from its beginning.

    Args:
        source: Content of its file.
        station: In place of every station the files name.
        runs: Where run directories are kept.
        part: Part and speed of each experiment that is executed; None for the whole.
        begin: Runs an experiment.
        json: Whether to print one document and nothing else.
        confirm: Confirms all robots at once.
    """
    from hil.workflow import check_driver, load_series, require_extras

    series = load_series(source, station)
    experiments = [replace(each, commissioning=part) for each in series.experiments]
    for experiment in experiments:
        check_driver(experiment)
        if part is None:
            require_extras(experiment.spec)
    confirm(moves_of(series, experiments))
    group = series.create_group(runs, station, part)

    def execute(experiment: Experiment, before: Document) -> Outcome:
        return _outcome(begin(replace(experiment, commissioning=part)))

    with group.held():
        _run(series, group, execute, json)


def resume_series(
    path: Path, begin: Begin, resume: Resume, json: bool, *, confirm: Callable[[Moves], object]
) -> None:
    """Go on with a series that ended early, from the run in which it did.

    If none is left to do, only the overview is written again.

    Args:
        path: Its folder.
        begin: Runs an experiment.
        resume: Goes on with a run.
        json: Whether to print one document and nothing else.
        confirm: Confirms all robots that are left at once.
    """
    from hil.recording import SeriesGroup
    from hil.workflow import commissioning_of_series, load_series
    from hil.workflow import run_series as run_all

    group = SeriesGroup.open(path)
    station, part = group.head.get("station"), commissioning_of_series(group)
    series = load_series(Path(group.head["source"]), Path(station) if station else None)

    def execute(experiment: Experiment, before: Document) -> Outcome:
        run = Path(before["run"]) if before.get("run") else None
        if run is None:
            return _outcome(begin(replace(experiment, commissioning=part)))
        if before.get("outcome") == "completed" and (run / "verdict.json").is_file():
            return _with_studies(run, before)
        return _outcome(resume(run))

    with group.held():
        members = group.members()
        if not series.is_finished(members):
            left = (replace(each, commissioning=part) for each in series.without_run(members))
            confirm(moves_of(series, left))
            _run(series, group, execute, json)
            return
        report = run_all(series, group, execute)
    if json:
        print_json({**report.to_dict(), "exit_code": 0})
    else:
        typer.echo(f"nothing is left to do of {series.spec.name}; overview: {_page(report)}")


def moves_of(series: Series, experiments: Iterable[Experiment]) -> Moves:
    """Return what experiments of a series move, by their place in it."""
    from hil.workflow import Moves

    places = {f"series.{i}": each for i, each in enumerate(experiments)}
    return Moves(series.source, series.spec.robots, places)


def _outcome(report: RunReport) -> Outcome:
    return report.to_dict(), report.error or rejected(report)


def rejected(report: RunReport) -> Rejected | None:
    """Return the error of a run whose model missed its criteria; None if it has none."""
    if report.verdict != "rejected":
        return None
    message = f"the model of {report.run} missed its acceptance criteria"
    return Rejected(message, hint=f"hil show {report.run}")


def _with_studies(run: Path, before: Document) -> Outcome:
    """Finish a run that was stopped during its studies: its models are there."""
    from hil import api
    from hil.cli.progress import StudyLine

    with StudyLine() as line:
        api.study(run, watch=line.show)
    return before, None


def _run(series: Series, group: SeriesGroup, execute: Execute, json: bool) -> None:
    from hil.workflow import run_series

    number = {each.spec.name: i for i, each in enumerate(series.experiments, 1)}

    def announced(experiment: Experiment, before: Document) -> Outcome:
        which = f"{number[experiment.spec.name]} of {len(series.experiments)}"
        typer.echo(f"{which}: {experiment.title}", err=True)
        return execute(experiment, before)

    report = run_series(series, group, announced)
    ignore_from_now_on()
    if json:
        print_json(report.to_dict())
    else:
        for each in report.members:
            if each.report.get("run"):
                print_run(Path(each.report["run"]))
                typer.echo()
        rows = [(each.experiment, each.robot, each.word) for each in report.members]
        rows += [(name, "", "not begun") for name in report.left]
        print_table(("experiment", "robot", "result"), rows)
        typer.echo(f"overview: {_page(report)}")
    if (error := report.error) is None:
        return
    if not all(each.measured for each in report.members):
        hint = f"when the cause is mended: hil resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)


def _page(report: SeriesReport) -> str:
    return str(report.page or "could not be made")
