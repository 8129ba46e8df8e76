"""`hil watch`, `hil pause`, `hil stop`, `hil answer`, `hil robots`: runs of other processes."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from hil.cli.output import JsonFlag, RunsOption, duration, print_json, print_table
from hil.core import json_text

if TYPE_CHECKING:
    from hil.workflow import BenchRobot, Reaction

RunChoice = Annotated[
    str,
    typer.Argument(
        help="Run directory, number or name of a run, or `last`; by default the only live one.",
        show_default=False,
    ),
]
Who = Annotated[str, typer.Option("--operator", help="Who asks; recorded. By default the user.")]
Reason = Annotated[str, typer.Option("--reason", help="Why; recorded.")]
Wait = Annotated[
    float,
    typer.Option(
        "--wait", min=0, metavar="SECONDS", help="How long to wait until the run has obeyed."
    ),
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    for verb in (watch, pause, stop, answer, robots):
        app.command()(verb)


def pause(
    run: RunChoice = "",
    runs: RunsOption = Path("runs"),
    operator: Who = "",
    reason: Reason = "",
    wait: Wait = 60.0,
    json: JsonFlag = False,
) -> None:
    """Pause a live run at its next checkpoint; the arm holds, `hil resume` lets it go on."""
    from hil.workflow import pause_run

    path = _chosen(run, runs)
    _tell(pause_run(path, who=operator or _user(), reason=reason, wait_s=wait), json)


def let_go_on(run: Path, operator: str, json: bool) -> None:
    """`hil resume` for a run that is live: it is paused, or has taken no notice of a pause yet."""
    from hil.workflow import resume_live_run

    _tell(resume_live_run(run, who=operator or _user()), json)


def stop(
    run: RunChoice = "",
    runs: RunsOption = Path("runs"),
    operator: Who = "",
    reason: Reason = "",
    wait: Wait = 60.0,
    json: JsonFlag = False,
) -> None:
    """Stop a live run now; what was recorded is kept, and `hil resume` can go on with it."""
    from hil.workflow import stop_run

    path = _chosen(run, runs)
    _tell(stop_run(path, who=operator or _user(), reason=reason, wait_s=wait), json)


def answer(
    run: Annotated[str, typer.Argument(help="Run directory, number or name.", show_default=False)],
    word: Annotated[
        Literal["yes", "no"], typer.Argument(metavar="yes|no", help="A no stops the run.")
    ],
    runs: RunsOption = Path("runs"),
    operator: Who = "",
    wait: Wait = 60.0,
    json: JsonFlag = False,
) -> None:
    """Answer what a live run is asking, such as whether a load is mounted."""
    from hil.workflow import answer_run

    path = _chosen(run, runs)
    _tell(answer_run(path, word == "yes", who=operator or _user(), wait_s=wait), json)


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

    found = bench(station)
    if json:
        print_json([robot.to_dict() for robot in found])
        return
    header = ("robot", "driver", "model", "resource", "held by", "run")
    print_table(header, [_row(robot) for robot in found])


def _row(robot: "BenchRobot") -> tuple[str, ...]:
    from hil.core import plain, since_words

    resource = robot.resource or ("private" if not robot.problem else "?")
    held = robot.problem or "nobody"
    if robot.holder is not None:
        beat = f"heartbeat {duration(robot.holder.heartbeat_s)} ago"
        said = robot.holder.content
        since = since_words(said) or "since ?"
        held = f"{plain(said.get('user', '?'))}, {robot.holder.process}, {since}, {beat}"
    elif resource == "private":
        held = ""
    run = " ".join(filter(None, (robot.run, robot.state and f"({robot.state})")))
    return robot.name, robot.driver, robot.model, resource, held, run


def _chosen(run: str, runs: Path) -> Path:
    from hil.runs import find_run
    from hil.workflow import only_live

    return find_run(run, runs) if run else only_live(runs)


def _user() -> str:
    from hil.core import user_name

    return user_name()


def _tell(reaction: "Reaction", json: bool) -> None:
    if json:
        print_json(reaction.to_dict())
        return
    where = f" at step {reaction.step + 1}/{reaction.steps}" if reaction.step >= 0 else ""
    reason = f": {reaction.reason}" if reaction.reason else ""
    typer.echo(f"{reaction.run}: {reaction.state or 'asked'}{where}{reason}")


def _while_read(items: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The items, until nobody reads what is printed any more (`hil watch | head`)."""
    for item in items:
        if getattr(sys.stdout, "gone", False):
            return
        yield item
