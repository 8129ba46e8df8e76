"""`hil export`: convert an identified model for other programs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.options import REGISTRY, JsonFlag, ModelArgument, RegistryOption, RunsOption
from hil.cli.output import fixed, print_json, print_table, say
from hil.core import DataError
from hil.export import TARGETS

app = typer.Typer()


@app.command()
def export(
    model: ModelArgument,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="File to write; for C a folder.", show_default=False)
    ],
    to: Annotated[str, typer.Option("--to", help=f"Target: {', '.join(TARGETS)}.")] = "c",
    prefix: Annotated[
        str | None, typer.Option(help="C only: prefix of files and symbols; default: hil.")
    ] = None,
    unchecked: Annotated[
        bool,
        typer.Option(
            "--no-check",
            help="Skip the check: for C without a compiler, for URDF whatever the deviation.",
        ),
    ] = False,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Export a model as C, URDF, ONNX, PyTorch or JSON, verified against the original.

    The name of a registered model selects its champion.
    """
    from hil import api

    folder = _folder(model, runs, registry)
    result = api.export_model(folder, out, to=to, prefix=prefix, unchecked=unchecked or None)
    document = {"model": str(folder), "to": to, **result.to_dict()}
    if json:
        print_json(document)
    elif to == "urdf":
        _print_urdf(document)
    else:
        _print(document)


def _folder(named: str, runs: Path, registry: Path) -> Path:
    """Return the folder of a model; for a registered name, the folder of its champion."""
    from hil.models import Registry
    from hil.runs import find_model

    try:
        return find_model(named, runs)
    except DataError:
        home = Registry(registry)
        if named not in home.names():
            raise
        return home.version(named).folder


def _print(export: dict[str, Any]) -> None:
    name = Path(export["out"]).name
    files = [file for file in export["files"] if file != name]
    say(f"{export['out']}: {', '.join(files)}" if files else export["out"])
    joints = f"{len(export['joint_names'])} joints"
    if export["effort_unit"]:
        joints += f", efforts in {export['effort_unit']}"
    say(f"  {export['parts']}; {joints}")
    not_run = "not checked: build the code and run its self-test on the target"
    say(f"  {export['checked'] or not_run}")
    for note in export["notes"]:
        say(f"  note: {note}")


def _print_urdf(export: dict[str, Any]) -> None:
    header = (
        "joint",
        "mass [kg]",
        "centre of mass [m]",
        "rotor [kg·m²]",
        "friction [N·m]",
        "damping [N·m·s/rad]",
        "deviation [N·m]",
    )
    print_table(header, _rows(export))
    for note in export["notes"]:
        say(f"  note: {note}")
    say(f"{export['out']}: {export['parts']}")
    say(f"  {export['checked']}")


def _rows(export: dict[str, Any]) -> list[tuple[str, ...]]:
    keys = ("mass_kg", "rotor_inertia_kgm2", "coulomb_nm", "viscous_nms_rad", "mismatch_nm")
    columns = (export[key] for key in ("joint_names", "joint_types", "com_m", *keys))
    rows = []
    for name, kind, com, *values in zip(*columns, strict=True):
        # The headings contain the units of revolute joints.
        units = ("", " kg", " N", " N·s/m", " N") if kind == "prismatic" else ("",) * 5
        mass, *others = (
            f"{fixed(value, 3)}{unit}" for value, unit in zip(values, units, strict=True)
        )
        rows.append((name, mass, ", ".join(fixed(x, 3) for x in com), *others))
    return rows
