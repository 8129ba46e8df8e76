"""`hil gains`: torque per motor current, from loads of known mass."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.models import Sources, found
from hil.cli.output import JsonFlag, RunsOption, print_json, print_table


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(gains)


def gains(
    sources: Sources,
    robot: Annotated[
        str, typer.Option("--robot", help="Built-in arm or URDF; by default what the data says.")
    ] = "",
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Drive gains [N·m/A] from dwells at the same poses under loads of known mass."""
    from hil.calibration import gains_of_sources

    result = gains_of_sources(found(sources, runs), robot or None)
    if json:
        print_json(result.to_dict())
        return
    masses = ", ".join(f"{mass:g}" for mass in result.masses)
    typer.echo(f"loads of {masses} kg at {result.poses} poses")
    _print(result.to_dict())


def _print(told: dict[str, Any]) -> None:
    names = told["joint_names"]
    declared = told["declared_nm_a"] or [None] * len(names)
    pairs = (("gain", "_nm_a"), ("k1", "_nm_a"), ("k2", "_nm_a2"))
    columns = [
        map(_with_error, told[key + unit], told[f"{key}_error{unit}"]) for key, unit in pairs
    ]
    shown = [f"{value:.2f}" if value is not None else "–" for value in declared]
    print_table(
        ("joint", "gain [N·m/A]", "K1 [N·m/A]", "K2 [N·m/A²]", "declared"),
        list(zip(names, *columns, shown, strict=True)),
    )
    for name, reason in told["not_determined"].items():
        typer.echo(f"  {name}: {reason}")
    for note in told["notes"]:
        typer.echo(f"  note: {note}")
    if told["yaml"]:
        typer.echo("\nfor a station or an import map:")
    for line in told["yaml"]:
        typer.echo(line)


def _with_error(value: float | None, error: float | None) -> str:
    return "–" if value is None or error is None else f"{value:.3f} ± {error:.3f}"
