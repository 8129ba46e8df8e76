"""`hil export`: an identified model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, print_json, print_table
from hil.deploy.export.targets import TARGETS


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(export)


def export(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="File to make; for C a folder.", show_default=False)
    ],
    to: Annotated[str, typer.Option("--to", help=f"What to write: {', '.join(TARGETS)}.")] = "c",
    prefix: Annotated[
        str | None, typer.Option(help="C: what files and symbols begin with; by default hil.")
    ] = None,
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="C: write it without a compiler to check it with.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Write a model for a controller, simulator or runtime, compared with the model first."""
    from hil import api

    told = api.export_model(model, out, to=to, prefix=prefix, unchecked=unchecked or None)
    found = {"model": str(model), "to": to, **told.to_dict()}
    if json:
        print_json(found)
    elif to == "urdf":
        _print_urdf(found)
    else:
        _print(found)


def _print(told: dict[str, Any]) -> None:
    name = Path(told["out"]).name
    files = [file for file in told["files"] if file != name]
    typer.echo(f"{told['out']}: {', '.join(files)}" if files else told["out"])
    joints = f"{len(told['joint_names'])} joints"
    if told["effort_unit"]:
        joints += f", efforts in {told['effort_unit']}"
    typer.echo(f"  {told['parts']}; {joints}")
    unrun = "not checked: build it and run its self-test where it is used"
    typer.echo(f"  {told['checked'] or unrun}")
    for note in told["notes"]:
        typer.echo(f"  note: {note}")


def _print_urdf(told: dict[str, Any]) -> None:
    print_table(
        ("joint", "mass [kg]", "centre of mass [m]", "rotor [kg·m²]", "friction [N·m]",
         "damping [N·m·s/rad]", "off by [N·m]"),
        _rows(told),
    )  # fmt: skip
    for note in told["notes"]:
        typer.echo(f"  note: {note}")
    made = "edited the robot's own URDF" if told["edited"] else "made from the built-in arm"
    typer.echo(f"{told['out']}: {made}; read back, torques agree to {told['round_trip']:.0e}")


def _rows(told: dict[str, Any]) -> list[tuple[str, ...]]:
    keys = ("mass_kg", "rotor_inertia_kgm2", "coulomb_nm", "viscous_nms_rad", "mismatch_nm")
    rows = []
    for name, com, *values in zip(
        told["joint_names"], told["com_m"], *(told[key] for key in keys), strict=True
    ):
        mass, *others = (f"{value:.3f}" for value in values)
        rows.append((name, mass, ", ".join(f"{x:.3f}" for x in com), *others))
    return rows
