"""`hil serve`: the dashboard."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import RunsOption
from hil.cli.registry import HERE, RegistryOption

Specs = Annotated[
    Path,
    typer.Option("--specs", help="Folder whose specs, stations and schedules are offered."),
]
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
    specs: Specs = Path("experiments"),
    schedules: Schedules = Path("schedules"),
    host: Host = "127.0.0.1",
    port: Port = None,
    name: Names = None,
    read_only: ReadOnly = False,
) -> None:
    """Serve the dashboard: live runs with Stop, prompts, catalogue, models, schedules."""
    import secrets

    from hil import plugins
    from hil.errors import PluginError

    if missing := plugins.absent_modules("web"):
        raise PluginError(
            f"the dashboard needs {' and '.join(missing)}, which is not installed",
            hint='pip install "hil[web]"',
        )
    from hil.web.serving import listen
    from hil.web.serving import serve as serve_there
    from hil.web.settings import Settings, is_loopback

    token = os.environ.get("HIL_TOKEN", "")
    if not token and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    settings = Settings(
        runs=runs,
        registry=registry,
        specs=specs if specs.is_dir() else None,
        schedules=schedules,
        host=host,
        names=tuple(name or ()),
        token=token,
        read_only=read_only,
    )
    serve_there(settings, listen(host, port), _tell)


def _tell(address: str) -> None:
    typer.echo(f"dashboard: {address}")
    typer.echo("Ctrl-C ends it; runs that it started go on.", err=True)
