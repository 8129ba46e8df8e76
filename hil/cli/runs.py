"""`hil runs` and `hil show`: list runs, and show the contents of one run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from hil.cli.options import JsonFlag, RunArgument, RunsOption
from hil.cli.output import fail, print_json, print_run, print_table, say
from hil.core import DataError, shell_word
from hil.report import duration

app = typer.Typer()


@app.command()
def runs(
    query: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[QUERY]...",
            help="Conditions that a run must meet: robot=ur5-*, status=completed, since=7d, "
            "'rmse<0.1', or a word of its name, description or operator. Default: all runs.",
            show_default=False,
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Rebuild the search index first.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """List or search runs, newest last, including interrupted and damaged runs."""
    from hil.recording import unreadable_folders
    from hil.runs import find_runs, list_runs

    searched = query or rebuild
    entries = find_runs(*(query or ()), runs=runs, rebuild=rebuild) if searched else list_runs(runs)
    unreadable = unreadable_folders(runs)
    for folder, why in unreadable:
        typer.echo(f"warning: {folder}: {why}; runs in it are not listed", err=True)
    if json:
        print_json(entries)
    elif entries:
        print_table(*(_search_results(entries) if searched else _list(entries, runs)))
    elif query:
        say(f"no run under {runs} meets the conditions: {' '.join(query)}")
    elif unreadable:
        say(f"no runs under {runs} in readable folders")
    else:
        say(f"no runs under {runs}; start one with: hil run SPEC")


_Table: TypeAlias = tuple[tuple[str, ...], list[tuple[str, ...]]]


def _list(entries: list[dict[str, Any]], runs: Path) -> _Table:
    columns: dict[str, list[str]] = {
        "run": [e["run"] for e in entries],
        "status": [e["status"] for e in entries],
        "duration": [duration(e["duration_s"] or 0.0) for e in entries],
        "verdict": [e["verdict"] for e in entries],
        "studies": [", ".join(e["studies"]) for e in entries],
        "next": _short([e["next"] for e in entries], [Path(e["run"]) for e in entries], runs),
    }
    optional = ("studies", "next")
    shown = [name for name, cells in columns.items() if name not in optional or any(cells)]
    return tuple(shown), list(zip(*(columns[name] for name in shown), strict=True))


_ABOUT_A_RUN = ("hil resume ", "hil report ")


def _short(commands: Sequence[str], paths: Sequence[Path], runs: Path) -> list[str]:
    """Return the commands with the run's number from the first column if this number is unique."""
    from hil.recording import number_of

    numbers = [number_of(path) for path in paths]
    elsewhere = "" if runs == Path("runs") else f" --runs {shell_word(runs)}"
    return [
        f"{' '.join(command.split()[:2])} {number}{elsewhere}"
        if command.startswith(_ABOUT_A_RUN) and number and numbers.count(number) == 1
        else command
        for command, number in zip(commands, numbers, strict=True)
    ]


def _search_results(entries: list[dict[str, Any]]) -> _Table:
    header = ("run", "status", "duration", "verdict", "serial", "RMSE on held-out data")
    rows: list[tuple[str, ...]] = [
        (
            e["run"],
            e["status"],
            duration(e["duration_s"] or 0.0),
            e["verdict"],
            e["serial"],
            ", ".join(_error(fit) for fit in e["fits"]),
        )
        for e in entries
    ]
    return header, rows


def _error(fit: dict[str, Any]) -> str:
    error = "not judged" if fit["rmse"] is None else f"{fit['rmse']:.4f} {fit['unit']}"
    return f"{fit['estimator']} {error}"


@app.command()
def show(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    verify: Annotated[
        bool, typer.Option("--verify", help="Also compare every file with its checksum.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Show one run: conditions, preflight, why it stopped or failed, accuracy of its models."""
    from hil.recording import RunDirectory
    from hil.runs import describe_run, find_run

    path = find_run(run, runs)
    problems = RunDirectory.open(path).verify() if verify else []
    if json:
        print_json(describe_run(path) | ({"problems": problems} if verify else {}))
    else:
        print_run(path)
    if problems:
        hint = "restore the run from an intact copy, or use the remaining data with care"
        fail(DataError(f"{path}: {'; '.join(problems)}", hint=hint), json)
    if verify and not json:
        typer.echo("all files are unchanged since the end of the run")
