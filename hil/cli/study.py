"""`hil study` and `hil validate-loads`: evaluations of whole runs, with tables and figures."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.options import JsonFlag, RunArgument, RunsOption
from hil.cli.output import fail, print_json, print_table, say
from hil.core import SpecError, Stopped, json_value
from hil.report import duration

if TYPE_CHECKING:
    from hil.studies import StudyResult, Table, Value

app = typer.Typer()


@app.command()
def study(
    run: RunArgument,
    name: Annotated[
        str,
        typer.Option(
            "--study", "-s", help="Compute only this study, even if the spec does not list it."
        ),
    ] = "",
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Study parameter as NAME=VALUE (YAML); repeatable."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Compare methods on the data of a run: compute its studies and rewrite the report."""
    from hil import api
    from hil.runs import find_run

    _make(find_run(run, runs), name, api.parse_parameters(options or ()), json)


@app.command()
def validate_loads(
    run: RunArgument,
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            help="Folder of a model that was fitted without a payload; repeatable. No model is "
            "fitted.",
        ),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator",
            "-e",
            help="Estimator to fit to the data of the first payload; repeatable. Default: the "
            "models of the run (validate: {under_loads: true}), or the estimators of its "
            "study.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Check the declared payloads of a run and evaluate models of the bare arm with them."""
    from hil.runs import find_run
    from hil.workflow import STUDY

    if model and estimator:
        raise SpecError("--model and --estimator exclude each other", hint="pass one of them")
    parameters: dict[str, Any] = {}
    if model or estimator:
        parameters = {
            "estimators": estimator or [],
            "models": [str(path) for path in model or ()],
        }
    _make(find_run(run, runs), STUDY, parameters, json)


def _make(path: Path, name: str, parameters: Mapping[str, Any], json: bool) -> None:
    """Compute all studies of a run, or one study by name, and print the results."""
    from hil.cli.progress import StudyLine
    from hil.report import render_report
    from hil.workflow import STUDY, entries_for, run_studies

    entries = entries_for(path, name or None, parameters)
    try:
        with StudyLine() as line:
            done = run_studies(path, entries, line.show, line.ended)
    except KeyboardInterrupt:
        verb = "validate-loads" if any(one.study == STUDY for one in entries) else "study"
        message = "interrupted; completed studies are kept"
        raise Stopped(message, hint=f"hil {verb} {path}", by_signal=True) from None
    page = render_report(path)
    if json:
        studies = [
            {"folder": str(folder), **json_value(result.to_dict())} for folder, result in done.made
        ]
        print_json({"run": str(done.run), "report": str(page), "studies": studies})
    elif done.made or done.error is None:
        for folder, result in done.made:
            _print(result)
            say(f"{result.study}: computed in {duration(result.seconds)} → {folder}")
        typer.echo(f"report: {page}")
    if done.error is not None:
        fail(done.error, json)


def _print(result: "StudyResult") -> None:
    """Print title, summary, warnings and tables of a study; for some studies, a shorter table."""
    from hil.report import columns_of, is_numeric

    for text in (result.title, *result.summary):
        say(text)
    for warning in result.warnings:
        say(f"Warning: {warning}")
    for title, table in _tables(result):
        typer.echo()
        say(title)
        numeric = [i for i in range(len(table.columns)) if is_numeric(table, i)]
        print_table(table.columns, zip(*columns_of(table), strict=True), right=numeric)
        if table.note:
            say(table.note)
    typer.echo()


def _tables(result: "StudyResult") -> "Iterator[tuple[str, Table]]":
    """Yield the tables of a study with their titles; for load validation, only the means."""
    from hil.report import protocol_mark

    for part in result.parts:
        for table in part.tables:
            mark = protocol_mark(part.protocol)
            title = f"{part.title}{f' ({mark})' if mark else ''}: {table.title}"
            if table.key == "table-load-errors":
                yield title, means(table)
            elif result.study != "load-validation":
                yield title, table


def means(errors: "Table") -> "Table":
    """Return the means of a table of errors, whose rows are named `LOAD, MODEL, PREDICTION`."""
    from hil.studies import Table

    by_model: dict[str, dict[str, Value]] = {}
    for name, *_, mean in errors.rows:
        model, _, prediction = str(name).rpartition(", ")
        by_model.setdefault(model, {})[prediction] = mean
    predictions = list(dict.fromkeys(one for row in by_model.values() for one in row))
    rows = tuple((model, *(row.get(one) for one in predictions)) for model, row in by_model.items())
    note = "Means over the joints; the report has each joint, declared and identified loads."
    return Table(errors.key, errors.title, ("load, model", *predictions), rows, note)
