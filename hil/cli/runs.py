"""`hil runs`, `hil show`: what came of runs."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from hil.cli.output import (
    JsonFlag,
    RunsOption,
    duration,
    out_width,
    print_json,
    print_table,
    say,
)
from hil.core import DataError, HilError, exit_code_of, shell_word

RunArgument = Annotated[
    str,
    typer.Argument(
        help="Run directory, or number or name of a run, or `last`.", show_default=False
    ),
]

_Table: TypeAlias = tuple[tuple[str, ...], list[tuple[str, ...]]]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(runs)
    app.command()(show)


def fail(error: HilError, json: bool) -> None:
    """The JSON document is out already: only the exit code and a line on stderr remain."""
    if not json:
        raise error
    typer.echo(f"{type(error).__name__}: {error}", err=True)
    raise typer.Exit(exit_code_of(error))


def tell_run(run: Path) -> None:
    """The summary of a run, as wide as the terminal; in a pipe as everywhere."""
    from hil.report import WIDTH, summary_lines

    for line in summary_lines(run, max(40, min(WIDTH, out_width() or WIDTH))):
        typer.echo(line)


def runs(
    query: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[QUERY]...",
            help="Terms that all hold: robot=ur5-*, status=completed, since=7d, 'rmse<0.1', or a "
            "word of name, description or operator; by default all runs.",
            show_default=False,
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Make the catalogue that queries use anew.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """List run directories, newest last; interrupted and damaged ones too."""
    if query or rebuild:
        from hil.runs import find_runs

        entries, table = find_runs(*(query or ()), runs=runs, rebuild=rebuild), _found
    else:
        from hil.runs import list_runs

        entries, table = list_runs(runs), partial(_listed, runs=runs)
    if json:
        print_json(entries)
    elif entries:
        print_table(*table(entries))
    elif query:
        say(f"no run under {runs} meets: {' '.join(query)}")
    else:
        say(f"no runs under {runs}; make one with: hil run SPEC")


def _listed(entries: list[dict[str, Any]], runs: Path) -> _Table:
    columns: dict[str, list[str]] = {
        "run": [e["run"] for e in entries],
        "status": [e["status"] for e in entries],
        "duration": [duration(e["duration_s"] or 0.0) for e in entries],
        "verdict": [e["verdict"] for e in entries],
        "studies": [", ".join(e["studies"]) for e in entries],
        "next": _short([e["next"] for e in entries], [Path(e["run"]) for e in entries], runs),
    }
    shown = [name for name, cells in columns.items() if name not in _OPTIONAL or any(cells)]
    return tuple(shown), list(zip(*(columns[name] for name in shown), strict=True))


_OPTIONAL = ("studies", "next")
"""Columns that are shown only if one of the runs has a value."""


_ABOUT_A_RUN = ("hil resume ", "hil report ")


def _short(commands: Sequence[str], paths: Sequence[Path], runs: Path) -> list[str]:
    """Return the commands with the number of the run, which is in the first column, if unique."""
    from hil.recording import number_of

    numbers = [number_of(path) for path in paths]
    elsewhere = "" if runs == Path("runs") else f" --runs {shell_word(runs)}"
    return [
        f"{' '.join(command.split()[:2])} {number}{elsewhere}"
        if command.startswith(_ABOUT_A_RUN) and number and numbers.count(number) == 1
        else command
        for command, number in zip(commands, numbers, strict=True)
    ]


def _found(entries: list[dict[str, Any]]) -> _Table:
    header = ("run", "status", "duration", "verdict", "serial", "RMSE on held-out data")
    rows: list[tuple[str, ...]] = [
        (
            e["run"],
            e["status"],
            duration(e["duration_s"] or 0.0),
            e["verdict"],
            e["serial"],
            ", ".join(_fit(fit) for fit in e["fits"]),
        )
        for e in entries
    ]
    return header, rows


def _fit(fit: dict[str, Any]) -> str:
    error = "not judged" if fit["rmse"] is None else f"{fit['rmse']:.4f} {fit['unit']}"
    return f"{fit['estimator']} {error}"


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
    from hil.recording import RunDirectory
    from hil.runs import find_run

    path = find_run(run, runs)
    problems = RunDirectory.open(path).verify() if verify else []
    if json:
        print_json(api.describe_run(path) | ({"problems": problems} if verify else {}))
    else:
        tell_run(path)
    if problems:
        hint = "take the run from a copy that is whole, or use what is left of it with care"
        fail(DataError(f"{path}: {'; '.join(problems)}", hint=hint), json)
    if verify and not json:
        typer.echo("every file is as the run left it")
