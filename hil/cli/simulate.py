"""`hil simulate`: test a model in controllers of a simulated arm."""

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


@app.command()
def simulate(
    model: ModelArgument,
    out: Annotated[
        Path,
        typer.Option("-o", "--out", help="Folder to create for the report.", show_default=False),
    ],
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="Station with the mock robot the model was fitted to; default: $HIL_STATION, "
            "station.yaml in the current folder, or a mock of the same arm.",
        ),
    ] = None,
    robot: Annotated[
        str,
        typer.Option(
            "--robot",
            help="Name of the robot in the station; default: the robot with the arm of the model.",
        ),
    ] = "",
    payload: Annotated[
        str, typer.Option("--payload", help="Mounted payload: MASS_KG or MASS_KG,X_M,Y_M,Z_M.")
    ] = "",
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=MOST_SEED, help="Random seed of the trajectory.")
    ] = 0,
    friction_share: Annotated[
        float,
        typer.Option(
            "--friction-share",
            help="Share of the dry friction that is compensated during hand guiding, below 1.",
        ),
    ] = FRICTION_SHARE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Simulate torque control with and without the model: tracking and hand guiding."""
    from hil import api
    from hil.cli.progress import MovingLine
    from hil.runs import find_model

    with MovingLine() as line:
        trial = api.simulate(
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
    """Print warnings, summary and the path of the report, which contains all tables."""
    from hil.control import found

    result = found(trial)
    print_warnings(result.warnings)
    typer.echo(f"report: {report}")
    for text in result.summary:
        say(text)


def _require_met(trial: "Trial") -> None:
    """Raise if the simulated model missed a criterion.

    Raises:
        Rejected: The model missed at least one criterion.
    """
    from hil.control import judged

    if missed := [criterion for criterion in judged(trial) if not criterion.met]:
        raise Rejected(
            f"{trial.estimator} missed its criteria: "
            f"{', and '.join(criterion.asked for criterion in missed)}",
            hint="; ".join(dict.fromkeys(criterion.mend for criterion in missed)),
        )
