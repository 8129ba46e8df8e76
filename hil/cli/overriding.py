"""Options that change what `hil run` executes and `hil plan` shows: --set, --speed, --first."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.core import SpecError

if TYPE_CHECKING:
    from hil.core import Source
    from hil.planning import Experiment

SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PATH=VALUE",
        help="Another value in the spec (YAML), such as excitation.waypoints=12; may be repeated.",
    ),
]
SpeedOption = Annotated[
    str,
    typer.Option(
        "--speed",
        metavar="SHARE",
        help="Commissioning run: the same program at a share of its speed (10%), without warm-up. "
        "No fit, no judgement.",
    ),
]
FirstOption = Annotated[
    str,
    typer.Option(
        "--first",
        metavar="N|SECONDSs",
        help="Commissioning run: only the first poses or trajectories (10; nearest poses first) or "
        "the first seconds (30s). No fit, no judgement.",
    ),
]


def load_with(
    spec: "Path | Source", station: Path | None, given: Sequence[str] | None
) -> "Experiment":
    """Load the experiment of a spec, or of what was read from its file, with values of `--set`.

    Warns on stderr where the built-in bench is taken and a station beside the spec has its robot.

    Raises:
        SpecError: As `hil.load`; what is wrong with a value is told at its option.
    """
    from hil.planning import load as load_experiment
    from hil.planning import passed_over

    experiment = load_experiment(spec, station, overrides=_overrides(given or ()))
    file = Path(experiment.spec_source)
    if told := passed_over(experiment.station_source, file, experiment.spec.robot):
        typer.echo(f"warning: {told}", err=True)
    return experiment


def refuse_set(given: Sequence[str] | None, what: str) -> None:
    """Refuse values for a file that names specs, any of which they might be for."""
    if given:
        raise SpecError(
            f"--set is for a single experiment, and this is {what}",
            hint="change the specs that it names, or give it others",
        )


def _overrides(given: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for number, text in enumerate(given, 1):
        path, equals, value = text.partition("=")
        if not equals or not path:
            raise SpecError(
                f"--set {number}: {text!r} is no PATH=VALUE",
                hint="such as --set excitation.waypoints=12",
            )
        if path.strip() in found:
            raise SpecError(
                f"--set {number}: {path.strip()}: has been given before, "
                f"by --set {list(found).index(path.strip()) + 1}",
                hint="give each path once",
            )
        found[path.strip()] = value
    return found
