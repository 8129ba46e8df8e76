"""`hil fit`, `hil evaluate`, `hil report`: pure functions of recorded data."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, RunsOption, print_json, print_table, say
from hil.cli.runs import RunArgument
from hil.cli.under_load import print_under_load
from hil.core import DataError

Sources = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE...",
        help="Runs (directory, name or number) or MCAP files.",
        show_default=False,
    ),
]

ModelArgument = Annotated[
    str,
    typer.Argument(
        help="Model folder, or a run (directory, name or number) with one model.",
        show_default=False,
    ),
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(fit)
    app.command()(evaluate)
    app.command()(report)


def fit(
    sources: Sources,
    estimator: Annotated[str, typer.Option("--estimator", "-e", help="Name of the estimator.")],
    robot: Annotated[
        str, typer.Option("--robot", help="Built-in arm or URDF; by default what the data says.")
    ] = "",
    payload: Annotated[
        str,
        typer.Option(
            "--payload",
            help="Declared load as MASS_KG or MASS_KG,X_M,Y_M,Z_M; by default what the data says.",
        ),
    ] = "",
    gains: Annotated[
        Path | None,
        typer.Option(
            "--gains",
            help="File with drive_gains_nm_a (hil gains -o); by default what the data says.",
        ),
    ] = None,
    validate: Annotated[
        list[str] | None,
        typer.Option("--validate", help="Held-out run or MCAP file; repeat for several."),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Estimator parameter as NAME=VALUE (YAML value)."),
    ] = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Where the model folder is made.")
    ] = Path("models"),
    page: Annotated[
        Path | None, typer.Option("--report", help="Also write an HTML report here.")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Keep a network's training here, and go on from it."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Fit an estimator to recordings and judge it on others."""
    from hil import api
    from hil.cli.progress import TrainingLine

    with TrainingLine() as line, _told_how_to_go_on(checkpoints):
        result = api.fit(
            found(sources, runs),
            estimator=estimator,
            robot=robot or None,
            payload=payload or None,
            gains=gains,
            validate=found(validate or (), runs),
            parameters=api.parse_parameters(options or ()),
            out=out,
            page=page,
            checkpoints=checkpoints,
            watch=line,
        )
    document = result.to_dict()
    if json:
        print_json(document)
        return
    say(f"{estimator}: fitted in {document['seconds']:.2f} s → {document['model']}")
    _print_validation(document["validation"])


@contextmanager
def _told_how_to_go_on(checkpoints: Path | None) -> Iterator[None]:
    """Says after Ctrl-C that a training was kept, where one was."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoints is not None and any(checkpoints.rglob("checkpoint.json")):
            kept = f"the training is kept in {checkpoints}; the same command goes on with it"
            typer.echo(kept, err=True)
        raise


def evaluate(
    model: ModelArgument,
    sources: Sources,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Judge a saved model on recordings it has not seen."""
    from hil import api

    folder = found_model(model, runs)
    rows = api.evaluate(folder, found(sources, runs))
    if json:
        print_json({"model": str(folder), "validation": rows})
    else:
        _print_validation(rows)


def report(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Write (again) the HTML report of a run, or the overview of a series."""
    from hil.recording import SeriesGroup
    from hil.report import render_report, render_series
    from hil.runs import find_run

    path = find_run(run, runs)
    page = render_series(path) if SeriesGroup.is_at(path) else render_report(path)
    if json:
        print_json({"run": str(path), "report": str(page)})
    else:
        typer.echo(str(page))


def found(sources: Iterable[str], runs: Path) -> list[Path]:
    """Files and directories as they are given; anything else is a run's name or number."""
    from hil.runs import find_run

    given = [(text, Path(text)) for text in sources]
    plain = [
        path.exists() or path.name != text or path.suffix == ".mcap"  # no run's name ends so
        for text, path in given
    ]
    return [
        path if as_it_is else find_run(text, runs)
        for (text, path), as_it_is in zip(given, plain, strict=True)
    ]


def found_model(named: str, runs: Path) -> Path:
    """The folder of a model: itself, or the only one in a folder or run, by path, name or number.

    Raises:
        DataError: There is none, or there are several.
    """
    from hil.estimators import only_model

    try:
        (path,) = found([named], runs)
    except DataError as error:
        told = f"there is no model folder {named}; {error.message}"
        raise DataError(told, hint=error.hint) from None
    return only_model(path)


def _print_validation(rows: list[dict[str, Any]]) -> None:
    if not rows:
        say("not validated; hold data out with: --validate SOURCE")
        return
    for row in rows:
        unit, n = row["unit"], len(row["rmse_raw"])
        say(f"validated on {row['source']} [{unit}]")
        print_table(
            ("RMSE", *(f"J{j + 1}" for j in range(n)), "mean"),
            [
                (label, *(f"{v:.4f}" for v in row[f"rmse_{key}"]), f"{row[f'mean_{key}']:.4f}")
                for label, key in (("raw", "raw"), ("filtered", "filtered"))
            ],
        )
        if row["under_load"]:
            print_under_load(row["under_load"])
        for note in row["notes"]:
            say(f"  note: {note}")
