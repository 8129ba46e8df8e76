"""`hil serve`: dashboard of runs, models and schedules in the browser."""

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
            help="Folder of the specs, stations and schedules; default: `experiments` if it "
            "exists, else the current folder.",
        ),
    ] = None,
    schedules: Annotated[
        Path, typer.Option("--schedules", help="Folder of the state folders of schedules (NAME/…).")
    ] = Path("schedules"),
    host: Annotated[
        str,
        typer.Option(
            "--host",
            help="Address to listen on. Browsers on other addresses than loopback need a token.",
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(
            "--port",
            min=0,
            max=65535,
            help="TCP port, 0 for any free port; default: the first free port from 8350 to 8359.",
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            "--name",
            metavar="HOST",
            help="Additional host name under which browsers reach the dashboard; repeatable.",
        ),
    ] = None,
    read_only: Annotated[
        bool,
        typer.Option(
            "--read-only",
            help="Serve pages only; starting, pausing, answering and stopping runs is disabled.",
        ),
    ] = False,
) -> None:
    """Serve the dashboard: start, watch and stop runs, browse runs, models and schedules."""
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
            typer.echo(f"with the token of $HIL_TOKEN: {address}?token=…", err=True)
        typer.echo("Ctrl-C ends the dashboard; runs that were started from it continue.", err=True)

    serve_dashboard(settings, listen(host, port), announce)


def specs_folder(folder: Path | None) -> Path:
    """Return the folder of specs; by default `experiments` if it exists, else the current folder.

    Raises:
        SpecError: The path `folder` is not a folder.
    """
    if folder is None:
        experiments = Path("experiments")
        return experiments if experiments.is_dir() else Path()
    if not folder.is_dir():
        raise SpecError(f"--specs {folder} is not a folder", hint="pass a folder with specs")
    return folder
