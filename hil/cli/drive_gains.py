"""`hil drive-gains`: torque per motor current, from known payloads or controller logs."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from hil.cli.options import JsonFlag, RunsOption, SourcesArgument
from hil.cli.output import print_json, print_table

if TYPE_CHECKING:
    from hil.evaluation import GainsMethod

app = typer.Typer()


@app.command()
def drive_gains(
    sources: SourcesArgument,
    robot: Annotated[
        str,
        typer.Option(
            "--robot", help="Built-in arm or URDF file; default: the arm named in the recording."
        ),
    ] = "",
    method: Annotated[
        str,
        typer.Option(
            "--method",
            help="Method: known-loads (dwells with several known payloads), controller (logged "
            "currents and torques) or auto.",
        ),
    ] = "auto",
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Also write the drive gains to this YAML file, for `hil fit --gains`.",
        ),
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Identify drive gains [N·m/A] from known payloads or from controller currents and torques."""
    from hil.estimators import write_gains
    from hil.evaluation import gains_of_sources
    from hil.runs import find_source

    recordings = [find_source(one, runs) for one in sources]
    result = gains_of_sources(recordings, robot or None, cast("GainsMethod", method)).to_dict()
    if out is not None:
        write_gains(out, result["yaml"])
    if json:
        print_json(result)
    elif result["method"] == "controller":
        samples = result["samples"]
        typer.echo(f"method: controller (logged currents and torques in {samples} samples)")
        _print(result, ("gain",), {"residual": map(_percent, result["residual_share"])})
    else:
        masses = ", ".join(f"{mass:g}" for mass in result["masses_kg"])
        typer.echo(f"method: known loads ({masses} kg at {result['poses']} poses)")
        _print(result, ("gain", "k1", "k2"), {})


COLUMNS = {
    "gain": ("gain [N·m/A]", "_nm_a"),
    "k1": ("K1 [N·m/A]", "_nm_a"),
    "k2": ("K2 [N·m/A²]", "_nm_a2"),
}
"""Heading of each column of the table, and the unit in the key of the JSON document."""


def _print(
    result: dict[str, Any], keys: tuple[str, ...], more: Mapping[str, Iterable[str]]
) -> None:
    names = result["joint_names"]
    columns = [
        map(_with_error, result[f"{key}{unit}"], result[f"{key}_error{unit}"])
        for key in keys
        for _, unit in [COLUMNS[key]]
    ]
    declared = [
        "–" if value is None else f"{value:.2f}"
        for value in result["declared_nm_a"] or [None] * len(names)
    ]
    print_table(
        ("joint", *(COLUMNS[key][0] for key in keys), *more, "declared"),
        list(zip(names, *columns, *more.values(), declared, strict=True)),
    )
    for name, reason in result["not_determined"].items():
        typer.echo(f"  {name}: {reason}")
    for note in result["notes"]:
        typer.echo(f"  note: {note}")
    if result["yaml"]:
        typer.echo("\nfor a station file, an import map or hil fit --gains:")
    for line in result["yaml"]:
        typer.echo(line)


def _with_error(value: float | None, error: float | None) -> str:
    return "–" if value is None or error is None else f"{value:.3f} ± {error:.3f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"
