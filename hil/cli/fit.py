"""`hil fit` and `hil evaluate`: fit models to recordings and evaluate models on others."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.options import (
    JsonFlag,
    ModelArgument,
    ParametersOption,
    RunsOption,
    SourcesArgument,
)
from hil.cli.output import fixed, print_errors, print_json, say

app = typer.Typer()


@app.command()
def fit(
    sources: SourcesArgument,
    estimator: Annotated[
        str,
        typer.Option("--estimator", "-e", help="Name of the estimator; `hil plugins` lists all."),
    ],
    robot: Annotated[
        str,
        typer.Option(
            "--robot", help="Built-in arm or URDF file; default: the arm named in the recording."
        ),
    ] = "",
    payload: Annotated[
        str,
        typer.Option(
            "--payload",
            help="Declared payload: MASS_KG or MASS_KG,X_M,Y_M,Z_M; default: the payload stored "
            "in the recording.",
        ),
    ] = "",
    gains: Annotated[
        Path | None,
        typer.Option(
            "--gains",
            help="YAML file with drive_gains_nm_a, as written by `hil drive-gains -o`; default: "
            "the drive gains stored in the recording.",
        ),
    ] = None,
    validate: Annotated[
        list[str] | None,
        typer.Option("--validate", help="Hold-out run or MCAP file; repeatable."),
    ] = None,
    options: ParametersOption = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder in which the model folder is created.")
    ] = Path("models"),
    page: Annotated[
        Path | None, typer.Option("--report", help="Also write an HTML report to this file.")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option(
            "--checkpoints",
            help="Folder for training checkpoints of a network; an "
            "interrupted training resumes from there.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Fit an estimator to recordings and evaluate the model on other recordings."""
    from hil import api
    from hil.cli.progress import TrainingLine
    from hil.runs import find_source

    with TrainingLine() as line, _resumable(checkpoints):
        result = api.fit(
            [find_source(one, runs) for one in sources],
            estimator=estimator,
            robot=robot or None,
            payload=payload or None,
            gains=gains,
            validate=[find_source(one, runs) for one in validate or ()],
            parameters=api.parse_parameters(options or ()),
            out=out,
            page=page,
            checkpoints=checkpoints,
            watch=line,
        )
    document = result.to_dict()
    if json:
        print_json(document)
        return
    say(f"{estimator}: fitted in {document['seconds']:.2f} s → {document['model']}")
    _print_validation(document["validation"])


@contextmanager
def _resumable(checkpoints: Path | None) -> Iterator[None]:
    """Print a message after Ctrl-C if the state of a network training is stored."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoints is not None and any(checkpoints.rglob("checkpoint.json")):
            message = f"the training is stored in {checkpoints}; the same command resumes it"
            typer.echo(message, err=True)
        raise


@app.command()
def evaluate(
    model: ModelArgument,
    sources: SourcesArgument,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Evaluate a saved model on recordings that it was not fitted to."""
    from hil import api
    from hil.runs import find_model, find_source

    folder = find_model(model, runs)
    validation = api.evaluate(folder, [find_source(one, runs) for one in sources])
    if json:
        print_json({"model": str(folder), "validation": validation})
    else:
        _print_validation(validation)


def _print_validation(validation: list[dict[str, Any]]) -> None:
    if not validation:
        say("not validated; pass a hold-out recording with: --validate SOURCE")
    for one in validation:
        say(f"validated on {one['source']} [{one['unit']}]")
        print_errors("RMSE", [("raw", one["rmse_raw"]), ("filtered", one["rmse_filtered"])])
        if one["under_load"]:
            print_under_load(one["under_load"])
        for note in one["notes"]:
            say(f"  note: {note}")


def print_under_load(under_load: dict[str, Any]) -> None:
    """Print the errors with and without knowledge of the load, and the check of that load."""
    declared, identified = under_load["declared"], under_load["identified"]
    new = "a load that was not in the training data, " if under_load["new"] else ""
    say(f"with {new}{_load(declared)} declared")
    print_errors("RMSE filtered", under_load["rmse"].items())
    if identified is None:
        say(f"  not identified: {under_load['failed']}")
        return
    mass_std = f"mass ± {under_load['mass_std_kg']:.3f} kg by noise alone"
    say(f"  identified: {_load(identified)}, {mass_std}")
    if not under_load["agrees"]:
        say(f"  the declared load is CONTRADICTED: {'; '.join(under_load['contradictions'])}")
    elif under_load["unless_gains_are_wrong"]:
        say(
            "  the declared load is neither contradicted nor confirmed. With exact drive gains: "
            f"{'; '.join(under_load['unless_gains_are_wrong'])}."
        )
        say(
            f"  Wrong drive gains can explain ±{under_load['mass_limit_kg']:.2f} kg; to decide, "
            "calibrate the gains (hil drive-gains) or record a run with several loads"
        )
    else:
        say("  the declared load agrees with the identified load")
    if declared["mass_kg"] and not under_load["mount_observable"]:
        say("  the declared centre is on the flange axis, so its mounting angle is not checked")


def _load(load: dict[str, Any]) -> str:
    if not load["mass_kg"]:
        return "no payload"
    centre = ", ".join(fixed(x, 3) for x in load["com_m"])
    return f"{load['mass_kg']:.3f} kg at ({centre}) m"
