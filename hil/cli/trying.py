"""`hil try-out`: what a model is worth to a controller, on a simulated arm."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import JsonFlag, print_json


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command("try-out")(try_out)


def try_out(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the report.", show_default=False)
    ],
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="Station with the simulated arm the model was fitted on; by default $HIL_STATION, "
            "station.yaml here, or a mock of its kind.",
        ),
    ] = None,
    robot: Annotated[
        str, typer.Option("--robot", help="Name in the station; by default the one that fits.")
    ] = "",
    payload: Annotated[
        str, typer.Option("--payload", help="What is mounted: MASS_KG or MASS_KG,X_M,Y_M,Z_M.")
    ] = "",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the trajectory.")] = 0,
    friction_share: Annotated[
        float,
        typer.Option("--friction-share", help="Of the dry friction, compensated while led; < 1."),
    ] = 0.5,
    json: JsonFlag = False,
) -> None:
    """Drive a simulated arm by torque with and without a model: tracking, and leading by hand."""
    from hil import api
    from hil.cli.study_tables import print_study
    from hil.trial.found import found

    def told(text: str) -> None:
        if sys.stderr.isatty():
            typer.echo(text, err=True)

    trial = api.try_out(
        model,
        out,
        station=station,
        robot=robot or None,
        payload=payload or None,
        seed=seed,
        friction_share=friction_share,
        progress=told,
    )
    if json:
        print_json({"report": str(out / "report.html"), **trial.to_dict()})
        return
    print_study(found(trial))
    typer.echo(f"report: {out / 'report.html'}")
