"""`hil study`, `hil figures`: evaluations of whole runs, and their figures as files."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.output import JsonFlag, RunsOption, duration, print_json, say
from hil.cli.runs import RunArgument, fail
from hil.core import Stopped

if TYPE_CHECKING:
    from hil.workflow import StudiesReport


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(study)
    app.command()(figures)


def study(
    run: RunArgument,
    name: Annotated[
        str, typer.Option("--study", "-s", help="Only this study, in the run's spec or not.")
    ] = "",
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Study parameter as NAME=VALUE (YAML value)."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Make the studies of a run (again), and its report: tables and figures of methods compared."""
    from hil import api
    from hil.runs import find_run

    make(find_run(run, runs), name, api.parse_parameters(options or ()), json)


def make(path: Path, name: str, parameters: Mapping[str, Any], json: bool) -> None:
    """Make the studies of a run directory, or one by name, and tell what they found."""
    from hil.cli.progress import StudyLine
    from hil.report import render_report
    from hil.workflow import STUDY, entries_for, run_studies

    entries = entries_for(path, name or None, parameters)
    try:
        with StudyLine() as line:
            done = run_studies(path, entries, line.show, line.ended)
    except KeyboardInterrupt:
        told = "interrupted; studies that were made before are kept"
        verb = "validate-loads" if any(one.study == STUDY for one in entries) else "study"
        raise Stopped(told, hint=f"hil {verb} {path}", by_signal=True) from None
    page = render_report(path)
    if done.made or done.error is None or json:
        _tell(done, page, json)
    if done.error is not None:
        fail(done.error, json)


def figures(
    run: Annotated[
        str, typer.Argument(help="Run (directory, name or number), or an HTML page that hil wrote.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the files.")],
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", "-f", help="pdf (default), svg or png; repeat for several."),
    ] = None,
    width: Annotated[
        str, typer.Option("--width", help="column (88 mm) or page (181 mm).")
    ] = "column",
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Write the figures of a run or a page, and tables of studies, as files for papers."""
    from hil import api
    from hil.runs import find_run

    page = Path(run)
    path = page if page.suffix == ".html" and page.is_file() else find_run(run, runs)
    written = api.figures(path, out, formats=tuple(formats or ("pdf",)), width=width)
    if json:
        print_json({"run": str(path), "files": [str(file) for file in written]})
        return
    for file in written:
        typer.echo(str(file))


def _tell(done: "StudiesReport", page: Path, json: bool) -> None:
    from hil.cli.study_tables import print_study

    if json:
        studies = [{"folder": str(folder), **result.to_dict()} for folder, result in done.made]
        print_json({"run": str(done.run), "report": str(page), "studies": studies})
        return
    for folder, result in done.made:
        print_study(result)
        say(f"{result.study}: made in {duration(result.seconds)} → {folder}")
    typer.echo(f"report: {page}")
