"""`hil payload`: the load in recordings, with its uncertainty."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.options import JsonFlag, ModelArgument, RunsOption, SourcesArgument
from hil.cli.output import fixed, print_errors, print_json, print_table, say

app = typer.Typer()


@app.command()
def payload(
    model: ModelArgument,
    sources: SourcesArgument,
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
    from hil.runs import find_model, find_source

    folder = find_model(model, runs)
    estimate = api.estimate_payload(
        folder,
        [find_source(one, runs) for one in sources],
        friction=friction,
        bare=[find_source(one, runs) for one in bare or ()],
        gain_share=None if gain_percent is None else gain_percent / 100,
    ).to_dict()
    if json:
        print_json({"model": str(folder), **estimate})
        return
    at_rest = estimate["friction"] == "rest"
    if other := estimate["other_arm"]:
        say(f"NOT TO BE RELIED ON: {other}; every arm has gains and masses of its own")
    if at_rest:
        say(f"load weighed at rest, at {estimate['samples']} poses")
    else:
        blocks = f"{estimate['blocks']} independent blocks of time"
        say(f"load in {estimate['samples']} samples, {blocks}")
    say(f"friction: {FRICTION[estimate['friction']]}")
    parameters = estimate["parameters"]
    print_table(
        ("parameter", "value", "± std", "95 % interval", "well determined"),
        [_row(each) for each in (parameters[:4] if at_rest else parameters)],
    )
    typer.echo("")
    print_errors(
        f"RMS error [{estimate['unit']}]",
        [
            ("with this load", estimate["residual"]),
            ("with nothing", estimate["residual_without_load"]),
        ],
    )
    if estimate["bounded"]:
        say("  note: the best fit is no body that exists; this is the best one that is")
    for note in estimate["notes"]:
        say(f"  note: {note}")
    mass = parameters[0]
    if mass["interval_95"][0] <= 0.0:
        say(
            f"\nno load shows: {mass['value']:.3f} kg, and nothing up to "
            f"{mass['interval_95'][1]:.3f} kg can be told from none"
        )
        return
    determined = any(one["determined"] for one in parameters[:4])
    if determined and None not in estimate["payload"]["com_m"] and not other:
        say("")
        for line in _declarations(estimate["payload"]):
            say(line)


FRICTION = {
    "model": "as the model has it",
    "offset": "the model's and an offset per joint",
    "scale": "the model's times a factor and an offset per joint",
    "rest": "cancelled between the two approaches of every pose",
}


def _row(parameter: dict[str, Any]) -> tuple[str, ...]:
    name = f"{parameter['name']} [{parameter['unit']}]"
    if parameter["value"] is None:
        return name, "–", "–", "does not show", "no"
    decimals = {"kg": 3, "m": 4}.get(parameter["unit"], 5)
    numbers = (parameter["value"], parameter["std_error"], *parameter["interval_95"])
    value, error, low, high = (fixed(number, decimals) for number in numbers)
    return name, value, error, f"{low} … {high}", "yes" if parameter["determined"] else "no"


def _declarations(load: dict[str, Any]) -> tuple[str, ...]:
    """Return the load as a spec, an import map and the option `--payload` declare it."""
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
