"""`hil try-out`: what a model is worth to a controller, on a simulated arm."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.options import JsonFlag, ModelArgument, RunsOption
from hil.cli.output import print_json, print_warnings, say
from hil.control import FRICTION_SHARE, MOST_SEED
from hil.core import Rejected

if TYPE_CHECKING:
    from hil.control import Trial

app = typer.Typer()


@app.command("try-out")
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
    from hil.cli.progress import MovingLine
    from hil.runs import find_model

    with MovingLine() as line:
        trial = api.try_out(
            find_model(model, runs),
            out,
            station=station,
            robot=robot or None,
            payload=payload or None,
            seed=seed,
            friction_share=friction_share,
            progress=line.show,
        )
    if json:
        print_json({"report": str(out / "report.html"), **trial.to_dict()})
    else:
        _print(trial, out / "report.html")
    _require_met(trial)


def _print(trial: "Trial", report: Path) -> None:
    """Print where the page is, which has all tables, and what a reader must know."""
    from hil.control import found

    result = found(trial)
    print_warnings(result.warnings)
    typer.echo(f"report: {report}")
    for text in result.summary:
        say(text)


def _require_met(trial: "Trial") -> None:
    """End with the exit code of a bad result if the model missed a criterion.

    Raises:
        Rejected: It has.
    """
    from hil.control import judged

    if missed := [criterion for criterion in judged(trial) if not criterion.met]:
        raise Rejected(
            f"{trial.estimator} missed what it is held to: "
            f"{', and '.join(criterion.asked for criterion in missed)}",
            hint="; ".join(dict.fromkeys(criterion.mend for criterion in missed)),
        )
