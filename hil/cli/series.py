"""Execution of series of experiments in `hil run` and `hil resume`.

Each experiment of a series is an ordinary run. All real robots are confirmed together before the
first run. A series that ended early is resumed with the run that ended early.
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
        source: Source with the content of the series file.
        station: Station file that replaces all stations in the files.
        runs: Folder in which the run directories are created.
        part: Executed part of each experiment and its speed; None for complete experiments.
        begin: Function that runs an experiment of the series.
        json: Whether to print only one JSON document.
        confirm: Function that confirms all robots of the series together.
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
    """Resume a series that ended early, beginning with the run that ended early.

    If all experiments are complete, only the overview page is written again.

    Args:
        path: Folder of the series to resume.
        begin: Function that runs an experiment of the series.
        resume: Function that resumes a run of the series.
        json: Whether to print only one JSON document.
        confirm: Function that confirms all remaining robots of the series together.
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
        typer.echo(f"{series.spec.name} is complete; overview: {_page(report)}")


def moves_of(series: Series, experiments: Iterable[Experiment]) -> Moves:
    """Return the motions of a series: its experiments by their position in the series."""
    from hil.workflow import Moves

    places = {f"series.{i}": each for i, each in enumerate(experiments)}
    return Moves(series.source, series.spec.robots, places)


def _outcome(report: RunReport) -> Outcome:
    return report.to_dict(), report.error or rejected(report)


def rejected(report: RunReport) -> Rejected | None:
    """Return the error of a run whose model missed its criteria; None if all criteria are met."""
    if report.verdict != "rejected":
        return None
    message = f"the model of {report.run} missed its acceptance criteria"
    return Rejected(message, hint=f"hil show {report.run}")


def _with_studies(run: Path, before: Document) -> Outcome:
    """Complete a run that was stopped during its studies, after its models had been fitted."""
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
        hint = f"after repairing the cause: hil resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)


def _page(report: SeriesReport) -> str:
    return str(report.page or "could not be created")
