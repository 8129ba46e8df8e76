"""`hil fit` and `hil evaluate`: models of recordings, and their errors on others."""

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
    estimator: Annotated[str, typer.Option("--estimator", "-e", help="Name of the estimator.")],
    robot: Annotated[
        str, typer.Option("--robot", help="Built-in arm or URDF; by default what the data says.")
    ] = "",
    payload: Annotated[
        str,
        typer.Option(
            "--payload",
            help="Declared load as MASS_KG or MASS_KG,X_M,Y_M,Z_M; by default what the data says.",
        ),
    ] = "",
    gains: Annotated[
        Path | None,
        typer.Option(
            "--gains",
            help="File with drive_gains_nm_a (hil gains -o); by default what the data says.",
        ),
    ] = None,
    validate: Annotated[
        list[str] | None,
        typer.Option("--validate", help="Held-out run or MCAP file; repeat for several."),
    ] = None,
    options: ParametersOption = None,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Where the model folder is made.")
    ] = Path("models"),
    page: Annotated[
        Path | None, typer.Option("--report", help="Also write an HTML report here.")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Keep a network's training here, and go on from it."),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Fit an estimator to recordings and judge it on others."""
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
    """Say after Ctrl-C that a training was kept, if one was."""
    try:
        yield
    except KeyboardInterrupt:
        if checkpoints is not None and any(checkpoints.rglob("checkpoint.json")):
            kept = f"the training is kept in {checkpoints}; the same command goes on with it"
            typer.echo(kept, err=True)
        raise


@app.command()
def evaluate(
    model: ModelArgument,
    sources: SourcesArgument,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Judge a saved model on recordings it has not seen."""
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
        say("not validated; hold data out with: --validate SOURCE")
    for one in validation:
        say(f"validated on {one['source']} [{one['unit']}]")
        print_errors("RMSE", [("raw", one["rmse_raw"]), ("filtered", one["rmse_filtered"])])
        if one["under_load"]:
            print_under_load(one["under_load"])
        for note in one["notes"]:
            say(f"  note: {note}")


def print_under_load(under_load: dict[str, Any]) -> None:
    """Print errors with and without the load of a recording, and whether it is the declared one."""
    declared, identified = under_load["declared"], under_load["identified"]
    new = "a load that it was not fitted with, " if under_load["new"] else ""
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
            "  the declared load is neither contradicted nor confirmed: by noise alone "
            f"{'; '.join(under_load['unless_gains_are_wrong'])},"
        )
        say(
            f"  but drive gains that are wrong may explain ±{under_load['mass_limit_kg']:.2f} kg; "
            "calibrated gains (hil gains) or a run with several loads would tell"
        )
    else:
        say("  the declared load agrees with it")
    if declared["mass_kg"] and not under_load["mount_observable"]:
        say("  its declared centre is on the flange's axis: no angle of its mount is checked")


def _load(load: dict[str, Any]) -> str:
    if not load["mass_kg"]:
        return "nothing"
    centre = ", ".join(fixed(x, 3) for x in load["com_m"])
    return f"{load['mass_kg']:.3f} kg at ({centre}) m"
