"""`hil export`: an identified model for other programs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.models import ModelArgument, found_model
from hil.cli.output import JsonFlag, RunsOption, fixed, print_json, print_table, say
from hil.cli.registry import HERE, RegistryOption
from hil.core import DataError
from hil.export import TARGETS


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(export)


def export(
    model: ModelArgument,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="File to make; for C a folder.", show_default=False)
    ],
    to: Annotated[str, typer.Option("--to", help=f"What to write: {', '.join(TARGETS)}.")] = "c",
    prefix: Annotated[
        str | None, typer.Option(help="C: what files and symbols begin with; by default hil.")
    ] = None,
    unchecked: Annotated[
        bool,
        typer.Option(
            "--unchecked", help="C: without a compiler to check it; URDF: however far off."
        ),
    ] = False,
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Write a model for a controller, simulator or runtime, compared with the model first.

    A name in the registry stands for its champion.
    """
    from hil import api

    folder = _folder(model, runs, registry)
    told = api.export_model(folder, out, to=to, prefix=prefix, unchecked=unchecked or None)
    found = {"model": str(folder), "to": to, **told.to_dict()}
    if json:
        print_json(found)
    elif to == "urdf":
        _print_urdf(found)
    else:
        _print(found)


def _folder(named: str, runs: Path, registry: Path) -> Path:
    """Of a model that is there, or else of the champion of that name."""
    from hil.models import Registry

    try:
        return found_model(named, runs)
    except DataError:
        if named not in (home := Registry(registry)).names():
            raise
        return home.version(named).folder


def _print(told: dict[str, Any]) -> None:
    name = Path(told["out"]).name
    files = [file for file in told["files"] if file != name]
    say(f"{told['out']}: {', '.join(files)}" if files else told["out"])
    joints = f"{len(told['joint_names'])} joints"
    if told["effort_unit"]:
        joints += f", efforts in {told['effort_unit']}"
    say(f"  {told['parts']}; {joints}")
    unrun = "not checked: build it and run its self-test where it is used"
    say(f"  {told['checked'] or unrun}")
    for note in told["notes"]:
        say(f"  note: {note}")


def _print_urdf(told: dict[str, Any]) -> None:
    print_table(
        ("joint", "mass [kg]", "centre of mass [m]", "rotor [kg·m²]", "friction [N·m]",
         "damping [N·m·s/rad]", "off by [N·m]"),
        _rows(told),
    )  # fmt: skip
    for note in told["notes"]:
        say(f"  note: {note}")
    say(f"{told['out']}: {told['parts']}")
    say(f"  {told['checked']}")


def _rows(told: dict[str, Any]) -> list[tuple[str, ...]]:
    keys = ("mass_kg", "rotor_inertia_kgm2", "coulomb_nm", "viscous_nms_rad", "mismatch_nm")
    rows = []
    for name, kind, com, *values in zip(
        told["joint_names"], told["joint_types"], told["com_m"], *(told[key] for key in keys),
        strict=True,
    ):  # fmt: skip
        slides = (" kg", " N", " N·s/m", " N") if kind == "prismatic" else ("",) * 4
        mass, *others = (
            f"{fixed(value, 3)}{unit}" for value, unit in zip(values, ("", *slides), strict=True)
        )
        rows.append((name, mass, ", ".join(fixed(x, 3) for x in com), *others))
    return rows
