"""`hil watch`, `pause`, `stop`, `answer` and `robots`: control of runs in other processes."""

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
            help="Run directory, run number, experiment name or `last`; default: the newest "
            "active run.",
            show_default=False,
        ),
    ] = "",
    runs: RunsOption = Path("runs"),
    exit_code: Annotated[
        bool, typer.Option("--exit-code", help="Return the exit code of the run.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document a line, as things happen.")
    ] = False,
) -> None:
    """Follow an active run until it ends. Ctrl-C ends the display; the run continues."""
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
            lines.line(f"stopped watching; the run continues: hil watch {path}")
    if exit_code:
        raise typer.Exit(code)


def _while_read(items: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the items while standard output has a reader (not after `hil watch | head`)."""
    for item in items:
        if getattr(sys.stdout, "gone", False):
            return
        yield item


RunOption = Annotated[
    str,
    typer.Argument(
        help="Run directory, run number, experiment name or `last`; default: the only active run.",
        show_default=False,
    ),
]
WhoOption = Annotated[
    str, typer.Option("--operator", help="Name recorded with the request; default: the login name.")
]
ReasonOption = Annotated[str, typer.Option("--reason", help="Reason of the request; recorded.")]
WaitOption = Annotated[
    float,
    typer.Option(
        "--wait", min=0, metavar="SECONDS", help="Longest time to wait until the run has reacted."
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
    """Pause an active run at its next checkpoint; the arm holds its pose until `hil resume`."""
    from hil.workflow import pause_run

    path = _run_of(run, runs)
    _print(pause_run(path, who=operator or user_name(), reason=reason, wait_s=wait), json)


def resume_live(run: Path, operator: str, json: bool) -> None:
    """End the pause of an active run, or cancel a requested pause; used by `hil resume`."""
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
    """Stop an active run now. The recording is kept, and `hil resume` can complete the run."""
    from hil.workflow import stop_run

    path = _run_of(run, runs)
    _print(stop_run(path, who=operator or user_name(), reason=reason, wait_s=wait), json)


@app.command()
def answer(
    run: Annotated[
        str,
        typer.Argument(help="Run directory, run number or experiment name.", show_default=False),
    ],
    word: Annotated[
        Literal["yes", "no"],
        typer.Argument(metavar="yes|no", help="Answer to the prompt; `no` stops the run."),
    ],
    runs: RunsOption = Path("runs"),
    operator: WhoOption = "",
    wait: WaitOption = 60.0,
    json: JsonFlag = False,
) -> None:
    """Answer the prompt of an active run, such as whether a payload is mounted."""
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
    typer.echo(f"{reaction.run}: {reaction.state or 'requested'}{where}{reason}")


@app.command()
def robots(
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="Station file; default: $HIL_STATION, station.yaml in the current folder, or the"
            " built-in mock robots.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """List the robots of a station, and the process that has leased each robot."""
    from hil.workflow import bench

    listed = bench(station)
    if json:
        print_json([robot.to_dict() for robot in listed])
        return
    header = ("robot", "driver", "model", "resource", "leased by", "run")
    print_table(header, [_row(robot) for robot in listed])


def _row(robot: "BenchRobot") -> tuple[str, ...]:
    from hil.core import plain, since_words

    resource = robot.resource or ("private" if not robot.problem else "?")
    held = robot.problem or "free"
    if robot.holder is not None:
        beat = f"heartbeat {duration(robot.holder.heartbeat_s)} ago"
        content = robot.holder.content
        since = since_words(content) or "since ?"
        held = f"{plain(content.get('user', '?'))}, {robot.holder.process}, {since}, {beat}"
    elif resource == "private":
        held = ""
    run = " ".join(filter(None, (robot.run, robot.state and f"({robot.state})")))
    return robot.name, robot.driver, robot.model, resource, held, run
