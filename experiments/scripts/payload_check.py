"""Before a shift: does the robot hold what it is told to hold?

    python experiments/scripts/payload_check.py MODEL --bare RUN

Runs `experiments/ur5_weigh.yaml` (six poses, half a minute) and compares mass and centre of mass
with the load that the spec declares to the controller. MODEL is of this arm, without a load; RUN is
the same program with nothing mounted, measured once. Exit codes: 0 nothing speaks against what is
declared; 10 it is another load: do not start; 20 the mass does not show in these poses, so that
nothing was checked; else those of `hil`, which has no 20.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated

import typer

import hil
from hil.core import HilError, SpecError
from hil.estimators import load_model_file

WRONG, NOT_CHECKED = 10, 20


def contradictions(
    names: list[str],
    declared: list[float],
    intervals: list[tuple[float, float]],
    tolerances: list[float],
) -> list[str]:
    """Return the quantities that differ from their declaration by more than the limits.

    What does not show has an interval of NaN, and contradicts nothing.
    """
    found = []
    for name, value, ends, allowed in zip(names, declared, intervals, tolerances, strict=True):
        low, high = ends
        if value + allowed < low or value - allowed > high:
            found.append(f"{name} is declared as {value:g} and is {low:.3f} … {high:.3f}")
    return found


def check(
    model: Path,
    spec: Path,
    station: Path | None,
    bare: list[Path],
    home: Path,
    tolerance_kg: float,
    tolerance_m: float,
    robot: str | None = None,
) -> tuple[list[str], bool]:
    """Weigh and print what was found; what contradicts the declaration, and whether mass shows."""
    experiment = hil.load(spec, station)
    if len(experiment.spec.loads) != 1:
        raise SpecError(f"{spec} has several loads", hint="declare the one that is mounted")
    (load,) = experiment.spec.loads
    load_model_file(model)  # what cannot be read is told before anything moves
    if bare:
        hil.dataset(*bare)
    report = hil.run(experiment, runs=home / "runs", robot=robot)
    if report.error is not None:
        raise report.error
    found = hil.estimate_payload(model, report.run, bare=bare)
    low, high = found.interval[0]
    print(
        f"weighed {found.values[0]:.2f} kg ({low:.2f} … {high:.2f}), declared {load.mass_kg:g} kg"
    )
    print(f"a mass wrong by less than {(high - low) / 2 + tolerance_kg:.2f} kg may not show")
    for note in (found.other_arm, *found.notes):
        if note:
            print(f"  note: {note}")
    wrong = contradictions(
        ["mass [kg]", "com_x [m]", "com_y [m]", "com_z [m]"],
        [load.mass_kg, *load.com_m],
        [(float(ends[0]), float(ends[1])) for ends in found.interval[:4]],
        [tolerance_kg, *[tolerance_m] * 3],
    )
    return wrong, math.isfinite(low) and math.isfinite(high)


def main(
    model: Annotated[Path, typer.Argument(help="Folder of a model of this arm.")],
    spec: Annotated[Path, typer.Option(help="Weighs, and declares the load.")] = Path(
        "experiments/ur5_weigh.yaml"
    ),
    station: Annotated[Path | None, typer.Option(help="Station file.")] = None,
    bare: Annotated[
        list[Path] | None, typer.Option(help="Run of the bare flange, much smaller errors.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Its name: a real robot moves only when it is named.")
    ] = None,
    home: Annotated[Path, typer.Option(help="Folder for runs.")] = Path(),
    tolerance_kg: Annotated[float, typer.Option(min=0, help="Allowed beyond the interval.")] = 0.1,
    tolerance_mm: Annotated[float, typer.Option(min=0, help="The same of the centre.")] = 15.0,
) -> None:
    """Weigh what the robot holds, and compare it with what is declared."""
    try:
        wrong, shown = check(
            model, spec, station, bare or [], home, tolerance_kg, tolerance_mm / 1000, robot
        )
    except (HilError, OSError) as error:
        print(f"NOT CHECKED: {error}", file=sys.stderr)
        raise typer.Exit(error.exit_code if isinstance(error, HilError) else 7) from error
    if wrong:
        print("DO NOT START: " + "; ".join(wrong))
        raise typer.Exit(WRONG)
    if not shown:
        print("NOT CHECKED: the mass does not show in these poses", file=sys.stderr)
        raise typer.Exit(NOT_CHECKED)
    print("OK: nothing speaks against what is declared")


if __name__ == "__main__":
    app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})
    app.command()(main)
    app()
