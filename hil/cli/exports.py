"""`hil urdf`: an identified model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, print_json, print_table


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(urdf)


def urdf(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="URDF to write.", show_default=False)],
    json: JsonFlag = False,
) -> None:
    """Write a model's arm as a URDF with the identified inertias, friction and rotor inertias."""
    from hil import api

    told = api.export_urdf(model, out).to_dict()
    if json:
        print_json({"model": str(model), **told})
        return
    print_table(
        ("joint", "mass [kg]", "centre of mass [m]", "rotor [kg·m²]", "friction [N·m]",
         "damping [N·m·s/rad]", "off by [N·m]"),
        _rows(told),
    )  # fmt: skip
    for note in told["notes"]:
        typer.echo(f"  note: {note}")
    made = "edited the robot's own URDF" if told["edited"] else "made from the built-in arm"
    typer.echo(f"{out}: {made}; read back, torques agree to {told['round_trip']:.0e}")


def _rows(told: dict[str, Any]) -> list[tuple[str, ...]]:
    keys = ("mass_kg", "rotor_inertia_kgm2", "coulomb_nm", "viscous_nms_rad", "mismatch_nm")
    rows = []
    for name, com, *values in zip(
        told["joint_names"], told["com_m"], *(told[key] for key in keys), strict=True
    ):
        mass, *others = (f"{value:.3f}" for value in values)
        rows.append((name, mass, ", ".join(f"{x:.3f}" for x in com), *others))
    return rows
