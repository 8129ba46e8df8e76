"""`hil payload`, `hil validate-loads`: loads of recordings, and whether they are those declared."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.models import ModelArgument, Sources, found, found_model
from hil.cli.output import JsonFlag, RunsOption, fixed, print_json, print_table, say
from hil.cli.runs import RunArgument
from hil.cli.studies import make
from hil.core import SpecError


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(payload)
    app.command()(validate_loads)


def payload(
    model: ModelArgument,
    sources: Sources,
    friction: Annotated[
        str,
        typer.Option(
            "--friction",
            help="What of the model's friction may differ on that day: model (nothing), offset, "
            "scale (offset and factor), or auto, which lets the recording choose.",
        ),
    ] = "auto",
    bare: Annotated[
        list[str] | None,
        typer.Option(
            "--bare",
            metavar="RUN",
            help="At rest: the same program run with nothing mounted; much smaller errors.",
        ),
    ] = None,
    gain_percent: Annotated[
        float | None,
        typer.Option(
            "--gain-percent",
            min=0.0,
            max=100.0,
            help="How well drive gains are known (one standard deviation), for the intervals; by "
            "default 5, 1 for gains from hil gains; torques have none.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Mass, centre of mass and inertia of the load in recordings, with their uncertainty.

    A recording of an arm at rest (experiments/ur5_weigh.yaml) tells mass and centre alone.
    """
    from hil import api

    folder = found_model(model, runs)
    estimate = api.estimate_payload(
        folder,
        found(sources, runs),
        friction=friction,
        bare=found(bare, runs) if bare else (),
        gain_share=None if gain_percent is None else gain_percent / 100,
    )
    told = estimate.to_dict()
    if json:
        print_json({"model": str(folder), **told})
        return
    if told["other_arm"]:
        say(f"NOT TO BE RELIED ON: {told['other_arm']}; every arm has gains and masses of its own")
    if told["friction"] == "rest":
        say(f"load weighed at rest, at {told['samples']} poses")
    else:
        blocks = f"{told['blocks']} independent blocks of time"
        say(f"load in {told['samples']} samples, {blocks}")
    say(f"friction: {FREED[told['friction']]}")
    print_table(
        ("parameter", "value", "± std", "95 % interval", "well determined"),
        [_row(each) for each in told["parameters"][: 4 if told["friction"] == "rest" else None]],
    )
    typer.echo("")
    n = len(told["joint_names"])
    print_table(
        (f"RMS error [{told['unit']}]", *(f"J{j + 1}" for j in range(n)), "mean"),
        [_errors("with this load", told["residual"]),
         _errors("with nothing", told["residual_without_load"])],
    )  # fmt: skip
    if told["bounded"]:
        say("  note: the best fit is no body that exists; this is the best one that is")
    for note in told["notes"]:
        say(f"  note: {note}")
    mass = told["parameters"][0]
    if mass["interval_95"][0] <= 0.0:
        say(
            f"\nno load shows: {mass['value']:.3f} kg, and nothing up to "
            f"{mass['interval_95'][1]:.3f} kg can be told from none"
        )
        return
    known = any(one["determined"] for one in told["parameters"][:4])
    if None in told["payload"]["com_m"] or told["other_arm"] or not known:
        return
    say("")
    for line in _lines(told["payload"]):
        say(line)


def validate_loads(
    run: RunArgument,
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            help="Folder of a model fitted without a load; none is fitted. Repeat for several.",
        ),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator",
            "-e",
            help="Fitted to the first load; repeat for several. By default the run's own models "
            "(validate: {under_loads: true}), or what its study names.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Errors of models of the bare arm under a run's loads, and each declared load checked."""
    from hil.runs import find_run

    if model and estimator:
        raise SpecError("--model and --estimator exclude each other", hint="give one of them")
    given: dict[str, Any] = {}
    if model:
        given = {"estimators": [], "models": [str(path) for path in model]}
    elif estimator:
        given = {"estimators": estimator, "models": []}
    make(find_run(run, runs), "load-validation", given, json)


FREED = {
    "model": "as the model has it",
    "offset": "the model's and an offset per joint",
    "scale": "the model's times a factor and an offset per joint",
    "rest": "cancelled between the two approaches of every pose",
}


def _row(told: dict[str, Any]) -> tuple[str, ...]:
    if told["value"] is None:
        return f"{told['name']} [{told['unit']}]", "–", "–", "does not show", "no"
    low, high = told["interval_95"]
    decimals = {"kg": 3, "m": 4}.get(told["unit"], 5)
    value, error, low, high = (
        fixed(number, decimals) for number in (told["value"], told["std_error"], low, high)
    )
    known = "yes" if told["determined"] else "no"
    return f"{told['name']} [{told['unit']}]", value, error, f"{low} … {high}", known


def _errors(label: str, values: list[float]) -> tuple[str, ...]:
    mean = sum(values) / len(values)
    return (label, *(f"{value:.4f}" for value in values), f"{mean:.4f}")


def _lines(load: dict[str, Any]) -> tuple[str, ...]:
    com = [fixed(x, 4) for x in load["com_m"]]
    mass = f"{load['mass_kg']:.3f}"
    inertia = ""
    if None not in load["inertia_kgm2"]:
        inertia = f", inertia_kgm2: [{', '.join(fixed(x, 5) for x in load['inertia_kgm2'])}]"
    body = f"{{mass_kg: {mass}, com_m: [{', '.join(com)}]{inertia}}}"
    without = " (which leaves the inertia out)" if inertia else ""
    return (
        f"for a spec:  loads: [{body}]",
        f"for a map:   payload: {body}",
        f"for options: --payload {','.join([mass, *com])}{without}",
    )
