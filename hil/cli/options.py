"""Arguments and options that several verbs share, and what they mean.

A verb names them in its signature. What they stand for is found by `hil.runs` (runs, recordings and
models by path, name or number) and by the functions below.
"""

from collections.abc import Iterable, Sequence
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.core import SpecError

if TYPE_CHECKING:
    from hil.core import Source
    from hil.planning import Experiment

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]

# Folders

RunsOption = Annotated[
    Path, typer.Option("--runs", envvar="HIL_RUNS", help="Where run directories are kept.")
]

RegistryOption = Annotated[
    Path,
    typer.Option("--registry", envvar="HIL_REGISTRY", help="Folder of the registered models."),
]
REGISTRY = Path("registry")

# What is read: runs, recordings, models

RunArgument = Annotated[
    str,
    typer.Argument(
        help="Run directory, or number or name of a run, or `last`.", show_default=False
    ),
]
SourcesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE...",
        help="Runs (directory, name or number) or MCAP files.",
        show_default=False,
    ),
]
ModelArgument = Annotated[
    str,
    typer.Argument(
        help="Model folder, or a run (directory, name or number) with one model.",
        show_default=False,
    ),
]
NameArgument = Annotated[str, typer.Argument(help="Name of the models, such as the robot's.")]
ParametersOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Estimator parameter as NAME=VALUE (YAML value)."),
]

# What is planned or moved

SpecArgument = Annotated[Path, typer.Argument(help="Experiment spec (YAML).", show_default=False)]
ScheduleArgument = Annotated[Path, typer.Argument(help="Schedule (YAML).", show_default=False)]
StationOption = Annotated[
    Path | None,
    typer.Option(
        "--station",
        help="Station file; by default $HIL_STATION, station.yaml beside the spec, or the "
        "built-in mock bench.",
    ),
]
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


def load_experiment(
    spec: "Path | Source", station: Path | None, set_: Sequence[str] | None
) -> "Experiment":
    """Load the experiment of a spec, with the values of `--set`.

    Warns on standard error if the built-in bench is taken and a station beside the spec has its
    robot.

    Args:
        spec: Its file, or what has been read from it.
        station: Station file; None for the default.
        set_: Texts `PATH=VALUE`.

    Raises:
        SpecError: As `hil.load`; a wrong value is located at its option.
    """
    from hil.planning import load, passed_over

    experiment = load(spec, station, overrides=_overrides(set_ or ()))
    file = Path(experiment.spec_source)
    if warning := passed_over(experiment.station_source, file, experiment.spec.robot):
        typer.echo(f"warning: {warning}", err=True)
    return experiment


def _overrides(texts: Sequence[str]) -> dict[str, str]:
    values: dict[str, str] = {}
    for number, text in enumerate(texts, 1):
        path, equals, value = text.partition("=")
        path = path.strip()
        if not (equals and path):
            raise SpecError(
                f"--set {number}: {text!r} is no PATH=VALUE",
                hint="such as --set excitation.waypoints=12",
            )
        if path in values:
            raise SpecError(
                f"--set {number}: {path}: has been given before, "
                f"by --set {list(values).index(path) + 1}",
                hint="give each path once",
            )
        values[path] = value
    return values


def refuse_set(set_: Sequence[str] | None, what: str) -> None:
    """Refuse `--set` for a file that names specs, any of which a value might be for.

    Raises:
        SpecError: There is a value.
    """
    if set_:
        raise SpecError(
            f"--set is for a single experiment, and this is {what}",
            hint="change the specs that it names, or give it others",
        )


# Who is at the robot, and what was decided about its motion

OperatorOption = Annotated[str, typer.Option("--operator", help="Who is at the robot; recorded.")]
WaiveOption = Annotated[
    list[str] | None,
    typer.Option(
        "--waive", metavar="NAME=REASON", help="Accept a failed preflight check; recorded."
    ),
]
YesFlag = Annotated[
    bool,
    typer.Option(
        "--yes",
        help="Move a real robot without a prompt (for scripts). The confirmation is recorded in "
        "the run.",
    ),
]


def waivers_of(texts: Iterable[str] | None) -> dict[str, str]:
    """Return the reasons of `NAME=REASON` texts by name.

    Raises:
        SpecError: One has no reason, so it waives nothing.
    """
    waivers = {}
    for text in texts or ():
        name, _, reason = text.partition("=")
        if not (name and reason.strip()):
            raise SpecError(
                f"--waive {name!r} gives no reason",
                hint='for example: --waive "disk=the recording is short"',
            )
        waivers[name] = reason.strip()
    return waivers


# Durations


def parse_duration(what: str, text: str, example: str) -> timedelta:
    """Return the duration that a person has typed, such as `90min` or `2 s`.

    Args:
        what: The option or argument, for the message.
        text: A number and its unit, or several: `1h30min`.
        example: How it is used, for the hint.

    Raises:
        SpecError: It is no duration.
    """
    from hil.core import duration_of

    try:
        return duration_of(text.replace(" ", ""))
    except ValueError as error:
        raise SpecError(f"{what} {error}", hint=f"for example: {example}") from None
