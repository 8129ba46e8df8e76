"""`hil report` and `hil figures`: results of a run as an HTML page and as files for papers."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag, RunArgument, RunsOption
from hil.cli.output import print_json

app = typer.Typer()


@app.command()
def report(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Rewrite the HTML report of a run, or the overview of a series."""
    from hil.recording import SeriesGroup
    from hil.report import render_report, render_series
    from hil.runs import find_run

    path = find_run(run, runs)
    page = render_series(path) if SeriesGroup.is_at(path) else render_report(path)
    if json:
        print_json({"run": str(path), "report": str(page)})
    else:
        typer.echo(str(page))


@app.command()
def figures(
    run: Annotated[
        str, typer.Argument(help="Run (directory, number or name), or an HTML report of hil.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the files.")],
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", "-f", help="File format: pdf (default), svg or png; repeatable."),
    ] = None,
    width: Annotated[
        str, typer.Option("--width", help="Width of the figures: column (88 mm) or page (181 mm).")
    ] = "column",
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Write figures and tables of a run as PDF, SVG or PNG files for papers."""
    from hil import api
    from hil.runs import find_run

    page = Path(run)
    path = page if page.suffix == ".html" and page.is_file() else find_run(run, runs)
    files = api.figures(path, out, formats=tuple(formats or ("pdf",)), width=width)
    if json:
        print_json({"run": str(path), "files": [str(file) for file in files]})
        return
    for file in files:
        typer.echo(str(file))
