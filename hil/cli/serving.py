"""`hil serve`: the dashboard."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import RunsOption
from hil.cli.registry import HERE, RegistryOption

SHORTEST_TOKEN = 16

Specs = Annotated[
    Path | None,
    typer.Option(
        "--specs",
        help="Folder whose specs, stations and schedules are offered; by default `experiments`, "
        "or this one where there is none.",
    ),
]
EXPERIMENTS = Path("experiments")
Schedules = Annotated[
    Path, typer.Option("--schedules", help="Where schedules keep their state (NAME/…).")
]
Host = Annotated[
    str,
    typer.Option(
        "--host", help="Address to listen on. Elsewhere than on loopback a token is asked for."
    ),
]
Port = Annotated[
    int | None,
    typer.Option(
        "--port", min=0, max=65535, help="TCP port, 0 for any; by default 8350 or one of the next."
    ),
]
Names = Annotated[
    list[str] | None,
    typer.Option("--name", metavar="HOST", help="Name that browsers call it by; may be repeated."),
]
ReadOnly = Annotated[
    bool, typer.Option("--read-only", help="Look only: start, pause, answer and stop nothing.")
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(serve)


def serve(
    runs: RunsOption = Path("runs"),
    registry: RegistryOption = HERE,
    specs: Specs = None,
    schedules: Schedules = Path("schedules"),
    host: Host = "127.0.0.1",
    port: Port = None,
    name: Names = None,
    read_only: ReadOnly = False,
) -> None:
    """Serve the dashboard: live runs with Stop, prompts, catalogue, models, schedules."""
    from hil.core import plugins

    if missing := plugins.absent_modules("web"):
        raise plugins.not_installed("the dashboard", missing, "web")
    from hil.dashboard import Settings, is_loopback, listen
    from hil.dashboard import serve as serve_there

    given = os.environ.get("HIL_TOKEN", "")
    token = given if is_loopback(host) else _token_for_all(given)
    settings = Settings(
        runs=runs,
        registry=registry,
        specs=_offered(specs),
        schedules=schedules,
        host=host,
        names=tuple(name or ()),
        token=token,
        token_given=bool(given),
        read_only=read_only,
    )
    serve_there(settings, listen(host, port), partial(_tell, given=bool(given)))


def _offered(given: Path | None) -> Path:
    """The folder of specs.

    Raises:
        SpecError: It is none.
    """
    from hil.core import SpecError

    if given is None:
        return EXPERIMENTS if EXPERIMENTS.is_dir() else Path()
    if not given.is_dir():
        raise SpecError(f"--specs {given} is no folder", hint="name one that holds specs")
    return given


def _token_for_all(given: str) -> str:
    """The token where a whole network may try.

    Raises:
        SpecError: That of the environment can be found by trying.
    """
    import secrets

    from hil.core import SpecError

    if given and len(given) < SHORTEST_TOKEN:
        raise SpecError(
            f"$HIL_TOKEN has {len(given)} characters, and whoever reaches this computer may try",
            hint=f"give it {SHORTEST_TOKEN} or more: HIL_TOKEN=$(openssl rand -hex 16)",
        )
    return given or secrets.token_urlsafe(24)


def _tell(address: str, *, given: bool = False) -> None:
    typer.echo(f"dashboard: {address}")
    if given:
        typer.echo(f"its token is that of $HIL_TOKEN: {address}?token=…", err=True)
    typer.echo("Ctrl-C ends it; runs that it started go on.", err=True)
