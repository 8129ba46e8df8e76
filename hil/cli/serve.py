"""`hil serve`: the dashboard."""

import os
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import REGISTRY, RegistryOption, RunsOption
from hil.core import SpecError

app = typer.Typer()


@app.command()
def serve(
    runs: RunsOption = Path("runs"),
    registry: RegistryOption = REGISTRY,
    specs: Annotated[
        Path | None,
        typer.Option(
            "--specs",
            help="Folder whose specs, stations and schedules are offered; by default "
            "`experiments`, or this one where there is none.",
        ),
    ] = None,
    schedules: Annotated[
        Path, typer.Option("--schedules", help="Where schedules keep their state (NAME/…).")
    ] = Path("schedules"),
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address to listen on. Elsewhere than on loopback a token is asked for."
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(
            "--port",
            min=0,
            max=65535,
            help="TCP port, 0 for any; by default 8350 or one of the next.",
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            "--name", metavar="HOST", help="Name that browsers call it by; may be repeated."
        ),
    ] = None,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="Look only: start, pause, answer and stop nothing.")
    ] = False,
) -> None:
    """Serve the dashboard: live runs with Stop, prompts, catalogue, models, schedules."""
    from hil.core import plugins

    if missing := plugins.absent_modules("web"):
        raise plugins.not_installed("the dashboard", missing, "web")
    from hil.dashboard import Settings, listen, token_for
    from hil.dashboard import serve as serve_dashboard

    token = os.environ.get("HIL_TOKEN", "")
    settings = Settings(
        runs=runs,
        registry=registry,
        specs=specs_folder(specs),
        schedules=schedules,
        host=host,
        names=tuple(name or ()),
        token=token_for(host, token),
        token_given=bool(token),
        read_only=read_only,
    )

    def announce(address: str) -> None:
        typer.echo(f"dashboard: {address}")
        if token:
            typer.echo(f"its token is that of $HIL_TOKEN: {address}?token=…", err=True)
        typer.echo("Ctrl-C ends it; runs that it started go on.", err=True)

    serve_dashboard(settings, listen(host, port), announce)


def specs_folder(folder: Path | None) -> Path:
    """Return the folder of specs; by default `experiments`, or this one if there is none.

    Raises:
        SpecError: It is no folder.
    """
    if folder is None:
        experiments = Path("experiments")
        return experiments if experiments.is_dir() else Path()
    if not folder.is_dir():
        raise SpecError(f"--specs {folder} is no folder", hint="name one that holds specs")
    return folder
