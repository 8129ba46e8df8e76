"""`hil payload`: payload of recordings, with its uncertainty."""

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
            help="Friction parameters to re-estimate with the payload: model (none), offset, "
            "scale (offset and factor), or auto (selected by cross-validation).",
        ),
    ] = "auto",
    bare: Annotated[
        list[str] | None,
        typer.Option(
            "--bare",
            metavar="RUN",
            help="Run of the same static program without a payload; reduces the errors "
            "considerably. Repeatable.",
        ),
    ] = None,
    gain_percent: Annotated[
        float | None,
        typer.Option(
            "--gain-percent",
            min=0.0,
            max=100.0,
            help="Standard deviation of the drive gains [%], for the intervals; default: 5, or 1 "
            "for gains of `hil drive-gains`. Unused for torques.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Identify mass, centre of mass and inertia of a tool or other payload from recordings.

    A static recording (experiments/ur5_weigh.yaml) determines only mass and centre of mass.
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
        say(f"NOT RELIABLE: {other}; drive gains and masses differ between arms")
    if at_rest:
        say(f"payload from gravity at {estimate['samples']} poses")
    else:
        blocks = f"{estimate['blocks']} independent blocks of time"
        say(f"payload from {estimate['samples']} samples, {blocks}")
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
            ("with payload", estimate["residual"]),
            ("without", estimate["residual_without_load"]),
        ],
    )
    if estimate["bounded"]:
        say(
            "  note: the best fit of all is not physically consistent; this is the best consistent "
            "one"
        )
    for note in estimate["notes"]:
        say(f"  note: {note}")
    mass = parameters[0]
    if mass["interval_95"][0] <= 0.0:
        say(
            f"\nno payload detected: {mass['value']:.3f} kg; up to "
            f"{mass['interval_95'][1]:.3f} kg cannot be distinguished from none"
        )
        return
    determined = any(one["determined"] for one in parameters[:4])
    if determined and None not in estimate["payload"]["com_m"] and not other:
        say("")
        for line in _declarations(estimate["payload"]):
            say(line)


FRICTION = {
    "model": "that of the model",
    "offset": "that of the model plus an offset per joint",
    "scale": "that of the model times a factor plus an offset per joint",
    "rest": "cancelled between the two approaches of every pose",
}


def _row(parameter: dict[str, Any]) -> tuple[str, ...]:
    name = f"{parameter['name']} [{parameter['unit']}]"
    if parameter["value"] is None:
        return name, "–", "–", "not observable", "no"
    decimals = {"kg": 3, "m": 4}.get(parameter["unit"], 5)
    numbers = (parameter["value"], parameter["std_error"], *parameter["interval_95"])
    value, error, low, high = (fixed(number, decimals) for number in numbers)
    return name, value, error, f"{low} … {high}", "yes" if parameter["determined"] else "no"


def _declarations(load: dict[str, Any]) -> tuple[str, ...]:
    """Return the payload in the formats of a spec, an import map and the option `--payload`."""
    com = [fixed(x, 4) for x in load["com_m"]]
    mass = f"{load['mass_kg']:.3f}"
    inertia = ""
    if None not in load["inertia_kgm2"]:
        inertia = f", inertia_kgm2: [{', '.join(fixed(x, 5) for x in load['inertia_kgm2'])}]"
    body = f"{{mass_kg: {mass}, com_m: [{', '.join(com)}]{inertia}}}"
    without = " (without the inertia)" if inertia else ""
    return (
        f"for a spec:  loads: [{body}]",
        f"for a map:   payload: {body}",
        f"for options: --payload {','.join([mass, *com])}{without}",
    )
