"""Verbs given a series of experiments: `hil run`, `hil validate`, `hil plan`, `hil resume`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hil.cli.output import duration, print_json, print_table, print_warnings, size
from hil.cli.runs import fail, tell_run
from hil.core import HilError

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


def validate_series(source: Source, station: Path | None, json: bool) -> None:
    """Check a series with everything it names; all problems at once."""
    from hil.workflow import Moves, check_driver, load_series, missing_extras

    series = load_series(source, station)
    for experiment in series.experiments:
        check_driver(experiment)
    Moves(series.source, series.spec.robots, _places(series.experiments)).real()
    missing = dict.fromkeys(told for one in series.experiments for told in missing_extras(one.spec))
    facts = [
        {"spec": each.spec_source, "name": each.spec.name, "station": each.station_source}
        for each in series.experiments
    ]
    if json:
        told = {"series": source.name, "name": series.spec.name, "runs": facts, "valid": True}
        print_json({**told, "warnings": list(missing)})
        return
    typer.echo(f"{source.name}: valid ({len(facts)} experiments)")
    for each in series.experiments:
        typer.echo(f"  {each.title}")
    print_warnings(missing)


def plan_series(
    source: Source, station: Path | None, part: Commissioning | None, connect: bool, json: bool
) -> None:
    """What each experiment of a series would do, and how long all of them take."""
    from hil.cli.progress import ExcitationLine
    from hil.workflow import load_series, preview_experiment

    told = []
    for each in load_series(source, station).experiments:
        experiment = replace(each, commissioning=part)
        with ExcitationLine() as line:
            _, preview = preview_experiment(experiment, connect=connect, watch=line)
        told.append((experiment, preview.to_dict()))
    total = {key: sum(facts[key] for _, facts in told) for key in ("duration_s", "recording_bytes")}
    if json:
        runs = [{"name": each.spec.name, **facts} for each, facts in told]
        print_json({"series": source.name, "runs": runs, **total})
        return
    rows = [_planned(each.spec.name, each.spec.robot, facts) for each, facts in told]
    rows.append(_planned("together", "", total))
    print_table(("experiment", "robot", "motion", "recording"), rows)
    typer.echo(f"of motion alone; margins and pictures: hil plan {told[0][0].spec_source}")
    for each, facts in told:
        for warning in facts["warnings"]:
            typer.echo(f"warning: {each.spec.name}: {warning}")


def _planned(name: str, robot: str, facts: dict[str, Any]) -> tuple[str, ...]:
    return name, robot, duration(facts["duration_s"]), size(facts["recording_bytes"])


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
        source: What was read from its file.
        station: In place of every station the files name.
        runs: Where run directories are kept.
        part: What of each experiment is executed, and how fast; None for all of it.
        begin: Runs an experiment.
        json: Whether to print one document and nothing else.
        confirm: Confirms all robots at once.
    """
    from hil.workflow import Moves, check_driver, load_series, require_extras

    series = load_series(source, station)
    for experiment in series.experiments:
        check_driver(replace(experiment, commissioning=part))
        if part is None:
            require_extras(experiment.spec)
    parts = (replace(each, commissioning=part) for each in series.experiments)
    confirm(Moves(series.source, series.spec.robots, _places(parts)))
    group = series.create_group(runs, station, part)

    def execute(experiment: Experiment, document: Document) -> Outcome:
        return _told(begin(replace(experiment, commissioning=part)))

    with group.held():
        _run(series, group, execute, json)


def resume_series(
    path: Path, begin: Begin, resume: Resume, json: bool, *, confirm: Callable[[Moves], object]
) -> None:
    """Go on with a series that ended early, from the run in which it did.

    Of one that came to its end only the overview is made anew.

    Args:
        path: Its folder.
        begin: Runs an experiment.
        resume: Goes on with a run.
        json: Whether to print one document and nothing else.
        confirm: Confirms all robots that are left at once.
    """
    from hil.recording import SeriesGroup
    from hil.workflow import Moves, commissioning_of_series, load_series

    group = SeriesGroup.open(path)
    station, part = group.head.get("station"), commissioning_of_series(group)
    series = load_series(Path(group.head["source"]), Path(station) if station else None)

    def execute(experiment: Experiment, told: Document) -> Outcome:
        run = Path(told["run"]) if told.get("run") else None
        if run is None:
            return _told(begin(replace(experiment, commissioning=part)))
        if told.get("outcome") == "completed" and (run / "verdict.json").is_file():
            return _studied(run, told)
        return _told(resume(run))

    with group.held():
        members = group.members()
        if series.is_finished(members):
            _tell_done(series, group, execute, json)
            return
        left = (replace(each, commissioning=part) for each in series.without_run(members))
        confirm(Moves(series.source, series.spec.robots, _places(left)))
        _run(series, group, execute, json)


def _places(experiments: Iterable[Experiment]) -> dict[str, Experiment]:
    """Return experiments by their place in a series."""
    return {f"series.{i}": each for i, each in enumerate(experiments)}


def _tell_done(series: Series, group: SeriesGroup, execute: Execute, json: bool) -> None:
    from hil.workflow import run_series

    report = run_series(series, group, execute)
    if json:
        print_json({**report.to_dict(), "exit_code": 0})
        return
    typer.echo(f"nothing is left to do of {series.spec.name}; overview: {_page(report)}")


def _run(series: Series, group: SeriesGroup, execute: Execute, json: bool) -> None:
    from hil.engine import ignore_from_now_on
    from hil.workflow import run_series

    number = {each.spec.name: i for i, each in enumerate(series.experiments, 1)}

    def announced(experiment: Experiment, told: Document) -> Outcome:
        which = f"{number[experiment.spec.name]} of {len(series.experiments)}"
        typer.echo(f"{which}: {experiment.title}", err=True)
        return execute(experiment, told)

    report = run_series(series, group, announced)
    ignore_from_now_on()
    _tell(report, json)


def _told(report: RunReport) -> Outcome:
    from hil.cli.attended import rejected

    return report.to_dict(), report.error or rejected(report)


def _studied(run: Path, told: Document) -> Outcome:
    """A run that was stopped during its studies: its models are there."""
    from hil import api
    from hil.cli.progress import StudyLine

    with StudyLine() as line:
        api.study(run, watch=line.show)
    return told, None


def _tell(report: SeriesReport, json: bool) -> None:
    error = report.error
    if json:
        print_json(report.to_dict())
    else:
        for each in report.members:
            if each.report.get("run"):
                tell_run(Path(each.report["run"]))
                typer.echo()
        rows = [(each.experiment, each.robot, each.word) for each in report.members]
        print_table(("experiment", "robot", "result"), [*rows, *_rows_not_begun(report)])
        typer.echo(f"overview: {_page(report)}")
    if error is None:
        return
    if not all(each.measured for each in report.members):
        hint = f"when the cause is mended: hil resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)


def _page(report: SeriesReport) -> str:
    return str(report.page or "could not be made")


def _rows_not_begun(report: SeriesReport) -> list[tuple[str, str, str]]:
    return [(name, "", "not begun") for name in report.left]
