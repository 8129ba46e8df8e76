"""`hil export` and `hil urdf`: an identified model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, print_json, print_table
from hil.errors import SpecError


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(urdf)
    app.command()(export)


def export(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to make.", show_default=False)],
    to: Annotated[str, typer.Option("--to", help="What to write: c.")] = "c",
    prefix: Annotated[str, typer.Option(help="What files and symbols begin with.")] = "hil",
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="Write it without a compiler to check it with.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Write a model as a C program for a controller, checked against the model in Python."""
    from hil import api

    if to != "c":
        raise SpecError(
            f"--to is {to!r}, but a model is written as: c", hint="urdf: see `hil urdf`"
        )
    told = api.export_c(model, out, prefix=prefix, unchecked=unchecked)
    if json:
        print_json({"model": str(model), "to": to, **told.to_dict()})
        return
    typer.echo(f"{told.out}: {', '.join(told.files)}")
    typer.echo(f"  {told.parts}; {len(told.joint_names)} joints, efforts in {told.effort_unit}")
    unrun = "not checked: build it and run its self-test where it is used"
    typer.echo(f"  {f'self-test: {told.checked}' if told.checked else unrun}")


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
