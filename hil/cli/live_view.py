"""`--live` of the verbs that move a robot."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hil.engine import Observer
    from hil.robot import Capabilities

LiveFlag = Annotated[
    bool,
    typer.Option("--live", help="Serve a live view to Foxglove or Lichtblick on this machine."),
]
LivePort = Annotated[
    int | None,
    typer.Option(
        "--live-port",
        min=0,
        max=65535,
        metavar="PORT",
        show_default=False,
        help="Serve it on this port, 0 for any; by default 8765 or the next free one.",
    ),
]
LiveHost = Annotated[
    str | None,
    typer.Option(
        "--live-host",
        metavar="ADDRESS",
        show_default=False,
        help="Serve it to other machines too: whoever reaches the address can watch.",
    ),
]


@contextlib.contextmanager
def live_view(
    robot: "Callable[[], Capabilities]", live: bool, port: int | None, host: str | None
) -> "Iterator[tuple[Observer, ...]]":
    """The observers of the live view, serving while inside; none when nobody asked for it.

    Raises:
        PluginError: It was asked for and cannot be served.
    """
    if not (live or port is not None or host):
        yield ()
        return
    from hil.engine import LAYOUT, LOOPBACK, FoxgloveLive, is_loopback

    host = host or LOOPBACK
    with FoxgloveLive(robot(), host=host, port=port) as view:
        typer.echo(f"live view: {view.url}\n   layout: {LAYOUT}", err=True)
        if not is_loopback(host):
            typer.secho(
                "  Warning: the live view has no password: whoever reaches this port can watch",
                err=True,
                fg=typer.colors.YELLOW,
            )
        yield (view,)


def recorded_capabilities(run: Path) -> "Capabilities":
    """What the robot of a run offered, by the run's own start document.

    Raises:
        DataError: It is no run directory, or the document lacks the robot.
    """
    from hil.core import DataError
    from hil.recording import RunDirectory
    from hil.robot import Capabilities

    try:
        robot = RunDirectory.open(run).start["robot"]
        return Capabilities(
            joint_names=tuple(map(str, robot["joint_names"])),
            rate_hz=float(robot["rate_hz"]),
            effort_kind=robot["effort_kind"],
            clock=robot["clock"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{run}/start.json does not say what the robot was: {error}",
            hint="resume without --live",
        ) from error
