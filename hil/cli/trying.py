"""`hil try-out`: what a model is worth to a controller, on a simulated arm."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.models import ModelArgument, found_model
from hil.cli.output import JsonFlag, RunsOption, fold, print_json, width_of
from hil.control import FRICTION_SHARE, MOST_SEED
from hil.core import Rejected

if TYPE_CHECKING:
    from hil.control import Trial


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command("try-out")(try_out)


def try_out(
    model: ModelArgument,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder to make for the report.", show_default=False)
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
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=MOST_SEED, help="Of the trajectory.")
    ] = 0,
    friction_share: Annotated[
        float,
        typer.Option("--friction-share", help="Of the dry friction, compensated while led; < 1."),
    ] = FRICTION_SHARE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Drive a simulated arm by torque with and without a model: tracking, and leading by hand."""
    from hil import api

    def told(text: str) -> None:
        if sys.stderr.isatty():
            typer.echo(text, err=True)

    trial = api.try_out(
        found_model(model, runs),
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
    else:
        _print(trial, out / "report.html")
    _require_met(trial)


def _print(trial: "Trial", report: Path) -> None:
    """Where everything is, and what a reader must know; all tables are on the page."""
    from hil.control import found

    width = width_of(sys.stdout)
    told = found(trial)
    for warning in told.warnings:
        typer.echo(fold(f"warning: {warning}", width))
    typer.echo(f"report: {report}")
    for text in told.summary:
        typer.echo(fold(text, width))


def _require_met(trial: "Trial") -> None:
    """End with the exit code of a bad result when the model missed a criterion.

    Raises:
        Rejected: It has.
    """
    from hil.control import judged

    if missed := [criterion for criterion in judged(trial) if not criterion.met]:
        asked = ", and ".join(criterion.asked for criterion in missed)
        raise Rejected(
            f"{trial.estimator} missed what it is held to: {asked}",
            hint="; ".join(dict.fromkeys(criterion.mend for criterion in missed)),
        )
