"""`hil watch`, `pause`, `stop`, `answer` and `robots`: live runs, which other processes execute."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from hil.cli.options import JsonFlag, RunsOption
from hil.cli.output import print_json, print_table
from hil.core import json_text, user_name
from hil.report import duration

if TYPE_CHECKING:
    from hil.workflow import BenchRobot, Reaction

app = typer.Typer()


@app.command()
def watch(
    run: Annotated[
        str,
        typer.Argument(
            help="Run directory, number or name of a run, or `last`; by default the newest live.",
            show_default=False,
        ),
    ] = "",
    runs: RunsOption = Path("runs"),
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="End with the run's own exit code.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document a line, as things happen.")
    ] = False,
) -> None:
    """Follow a live run to its end; Ctrl-C ends the watching, not the run."""
    from hil.cli.progress import WatchLines
    from hil.runs import find_run
    from hil.workflow import follow, newest_live

    path = find_run(run, runs) if run else newest_live(runs)
    lines = WatchLines(str(path), terminal=not json and sys.stdout.isatty())
    code = 130
    try:
        for item in _while_read(follow(path)):
            if json:
                typer.echo(json_text(item))
            else:
                lines.show(item)
            code = item.get("exit_code", code)
    except KeyboardInterrupt:
        if not json:
            lines.line(f"not watching any more; the run goes on: hil watch {path}")
    if exit_code:
        raise typer.Exit(code)


def _while_read(items: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the items until the reader of standard output has gone (`hil watch | head`)."""
    for item in items:
        if getattr(sys.stdout, "gone", False):
            return
        yield item


RunOption = Annotated[
    str,
    typer.Argument(
        help="Run directory, number or name of a run, or `last`; by default the only live one.",
        show_default=False,
    ),
]
WhoOption = Annotated[
    str, typer.Option("--operator", help="Who asks; recorded. By default the user.")
]
ReasonOption = Annotated[str, typer.Option("--reason", help="Why; recorded.")]
WaitOption = Annotated[
    float,
    typer.Option(
        "--wait", min=0, metavar="SECONDS", help="How long to wait until the run has obeyed."
    ),
]


@app.command()
def pause(
    run: RunOption = "",
    runs: RunsOption = Path("runs"),
    operator: WhoOption = "",
    reason: ReasonOption = "",
    wait: WaitOption = 60.0,
    json: JsonFlag = False,
) -> None:
    """Pause a live run at its next checkpoint; the arm holds, `hil resume` lets it go on."""
    from hil.workflow import pause_run

    path = _run_of(run, runs)
    _print(pause_run(path, who=operator or user_name(), reason=reason, wait_s=wait), json)


def resume_live(run: Path, operator: str, json: bool) -> None:
    """Let a live run go on that is paused, or has not yet obeyed a pause: `hil resume` of it."""
    from hil.workflow import resume_live_run

    _print(resume_live_run(run, who=operator or user_name()), json)


@app.command()
def stop(
    run: RunOption = "",
    runs: RunsOption = Path("runs"),
    operator: WhoOption = "",
    reason: ReasonOption = "",
    wait: WaitOption = 60.0,
    json: JsonFlag = False,
) -> None:
    """Stop a live run now; what was recorded is kept, and `hil resume` can go on with it."""
    from hil.workflow import stop_run

    path = _run_of(run, runs)
    _print(stop_run(path, who=operator or user_name(), reason=reason, wait_s=wait), json)


@app.command()
def answer(
    run: Annotated[str, typer.Argument(help="Run directory, number or name.", show_default=False)],
    word: Annotated[
        Literal["yes", "no"], typer.Argument(metavar="yes|no", help="A no stops the run.")
    ],
    runs: RunsOption = Path("runs"),
    operator: WhoOption = "",
    wait: WaitOption = 60.0,
    json: JsonFlag = False,
) -> None:
    """Answer what a live run is asking, such as whether a load is mounted."""
    from hil.workflow import answer_run

    path = _run_of(run, runs)
    _print(answer_run(path, word == "yes", who=operator or user_name(), wait_s=wait), json)


def _run_of(run: str, runs: Path) -> Path:
    from hil.runs import find_run
    from hil.workflow import only_live

    return find_run(run, runs) if run else only_live(runs)


def _print(reaction: "Reaction", json: bool) -> None:
    if json:
        print_json(reaction.to_dict())
        return
    where = f" at step {reaction.step + 1}/{reaction.steps}" if reaction.step >= 0 else ""
    reason = f": {reaction.reason}" if reaction.reason else ""
    typer.echo(f"{reaction.run}: {reaction.state or 'asked'}{where}{reason}")


@app.command()
def robots(
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="Station file; by default $HIL_STATION, station.yaml here, or the built-in mock "
            "bench.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """List the robots of a station, and which process holds each of them."""
    from hil.workflow import bench

    listed = bench(station)
    if json:
        print_json([robot.to_dict() for robot in listed])
        return
    header = ("robot", "driver", "model", "resource", "held by", "run")
    print_table(header, [_row(robot) for robot in listed])


def _row(robot: "BenchRobot") -> tuple[str, ...]:
    from hil.core import plain, since_words

    resource = robot.resource or ("private" if not robot.problem else "?")
    held = robot.problem or "nobody"
    if robot.holder is not None:
        beat = f"heartbeat {duration(robot.holder.heartbeat_s)} ago"
        content = robot.holder.content
        since = since_words(content) or "since ?"
        held = f"{plain(content.get('user', '?'))}, {robot.holder.process}, {since}, {beat}"
    elif resource == "private":
        held = ""
    run = " ".join(filter(None, (robot.run, robot.state and f"({robot.state})")))
    return robot.name, robot.driver, robot.model, resource, held, run
