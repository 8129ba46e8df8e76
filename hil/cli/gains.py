"""`hil gains`: torque per motor current, from known loads or from the controller's own log."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.models import Sources, found
from hil.cli.output import JsonFlag, RunsOption, print_json, print_table

if TYPE_CHECKING:
    from hil.evaluation import GainsMethod


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(gains)


def gains(
    sources: Sources,
    robot: Annotated[
        str, typer.Option("--robot", help="Built-in arm or URDF; by default what the data says.")
    ] = "",
    method: Annotated[
        str,
        typer.Option(
            "--method",
            help="known-loads (dwells under several loads), controller (its currents and torques "
            "were logged) or auto.",
        ),
    ] = "auto",
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Also write them here, for hil fit --gains.")
    ] = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Drive gains [N·m/A] from known loads, or from the controller's own currents and torques."""
    from typing import cast

    from hil.estimators import write_gains
    from hil.evaluation import gains_of_sources

    result = gains_of_sources(found(sources, runs), robot or None, cast("GainsMethod", method))
    told = result.to_dict()
    if out is not None:
        write_gains(out, told["yaml"])
    if json:
        print_json(told)
    elif told["method"] == "controller":
        typer.echo(f"method: controller, its currents and torques in {told['samples']} samples")
        _print(told, ("gain",), {"residual": map(_percent, told["residual_share"])})
    else:
        masses = ", ".join(f"{mass:g}" for mass in told["masses_kg"])
        typer.echo(f"method: known loads, loads of {masses} kg at {told['poses']} poses")
        _print(told, ("gain", "k1", "k2"), {})


COLUMNS = {
    "gain": ("gain [N·m/A]", "_nm_a"),
    "k1": ("K1 [N·m/A]", "_nm_a"),
    "k2": ("K2 [N·m/A²]", "_nm_a2"),
}


def _print(told: dict[str, Any], keys: tuple[str, ...], more: Mapping[str, Iterable[str]]) -> None:
    names = told["joint_names"]
    declared = told["declared_nm_a"] or [None] * len(names)
    units = [COLUMNS[key][1] for key in keys]
    columns = [
        map(_with_error, told[key + unit], told[f"{key}_error{unit}"])
        for key, unit in zip(keys, units, strict=True)
    ]
    shown = [f"{value:.2f}" if value is not None else "–" for value in declared]
    print_table(
        ("joint", *(COLUMNS[key][0] for key in keys), *more, "declared"),
        list(zip(names, *columns, *more.values(), shown, strict=True)),
    )
    for name, reason in told["not_determined"].items():
        typer.echo(f"  {name}: {reason}")
    for note in told["notes"]:
        typer.echo(f"  note: {note}")
    if told["yaml"]:
        typer.echo("\nfor a station, an import map or hil fit --gains:")
    for line in told["yaml"]:
        typer.echo(line)


def _with_error(value: float | None, error: float | None) -> str:
    return "–" if value is None or error is None else f"{value:.3f} ± {error:.3f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"
