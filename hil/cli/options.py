"""Arguments and options that several verbs share.

A verb uses these arguments and options in its signature. The module `hil.runs` finds runs,
recordings and models by path, name or number; the functions in this module evaluate the other
options.
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
    Path, typer.Option("--runs", envvar="HIL_RUNS", help="Folder of the run directories.")
]

RegistryOption = Annotated[
    Path,
    typer.Option(
        "--registry", envvar="HIL_REGISTRY", help="Folder of the registered models (registry)."
    ),
]
REGISTRY = Path("registry")

# Inputs: runs, recordings, models

RunArgument = Annotated[
    str,
    typer.Argument(
        help="Run directory, run number, experiment name or `last`.", show_default=False
    ),
]
SourcesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE...",
        help="Runs (directory, number or name) or MCAP files.",
        show_default=False,
    ),
]
ModelArgument = Annotated[
    str,
    typer.Argument(
        help="Model folder, or a run (directory, number or name) with exactly one model.",
        show_default=False,
    ),
]
NameArgument = Annotated[
    str, typer.Argument(help="Name of the registered model, such as the name of the robot.")
]
ParametersOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Estimator parameter as NAME=VALUE (YAML); repeatable."),
]

# Specs and commissioning

SpecArgument = Annotated[Path, typer.Argument(help="Experiment spec (YAML).", show_default=False)]
ScheduleArgument = Annotated[Path, typer.Argument(help="Schedule (YAML).", show_default=False)]
StationOption = Annotated[
    Path | None,
    typer.Option(
        "--station",
        help="Station file; default: $HIL_STATION, station.yaml in the folder of the spec, or the"
        " built-in mock robots.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PATH=VALUE",
        help="Override a value of the spec (YAML), such as excitation.waypoints=12; repeatable.",
    ),
]
SpeedOption = Annotated[
    str,
    typer.Option(
        "--speed-scale",
        metavar="SHARE",
        help="Commissioning run: the same program at reduced speed, such as 10%. No warm-up, fit "
        "or verdict.",
    ),
]
FirstOption = Annotated[
    str,
    typer.Option(
        "--limit",
        metavar="N|SECONDSs",
        help="Commissioning run: only the first N poses (nearest first) or trajectories, or the "
        "first seconds (30s). No fit or verdict.",
    ),
]


def load_experiment(
    spec: "Path | Source", station: Path | None, set_: Sequence[str] | None
) -> "Experiment":
    """Load the experiment of a spec, with the values of `--set`.

    A warning is printed on standard error if the built-in station is used although a station beside
    the spec has the robot.

    Args:
        spec: Spec file, or the content of the file if it was read before.
        station: Station file; None for the default station.
        set_: Texts of the form `PATH=VALUE`.

    Raises:
        SpecError: The spec or the station has problems, see `hil.load`. The message about an
            invalid value names its `--set` option.
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
                f"--set {number}: expected PATH=VALUE, got {text!r}",
                hint="for example: --set excitation.waypoints=12",
            )
        if path in values:
            raise SpecError(
                f"--set {number}: {path}: is already set by --set {list(values).index(path) + 1}",
                hint="pass each path once",
            )
        values[path] = value
    return values


def refuse_set(set_: Sequence[str] | None, what: str) -> None:
    """Raise if `--set` is used for a file that names several specs.

    Raises:
        SpecError: The command line contains at least one `--set`.
    """
    if set_:
        raise SpecError(
            f"--set is only for a single experiment, but this file is {what}",
            hint="edit the specs that the file names",
        )


# Operator, waivers, confirmation

OperatorOption = Annotated[
    str, typer.Option("--operator", help="Name of the operator at the robot; recorded in the run.")
]
WaiveOption = Annotated[
    list[str] | None,
    typer.Option(
        "--waive",
        metavar="NAME=REASON",
        help="Accept a failed preflight check, with a reason; recorded in the run.",
    ),
]
YesFlag = Annotated[
    bool,
    typer.Option(
        "--yes",
        help="Move a real robot without a prompt, for scripts. The confirmation is recorded in "
        "the run.",
    ),
]


def waivers_of(texts: Iterable[str] | None) -> dict[str, str]:
    """Return the reason of each waiver by name, from texts of the form `NAME=REASON`.

    Raises:
        SpecError: A waiver has no reason.
    """
    waivers = {}
    for text in texts or ():
        name, _, reason = text.partition("=")
        if not (name and reason.strip()):
            raise SpecError(
                f"--waive {name!r} has no reason",
                hint='for example: --waive "disk=the recording is short"',
            )
        waivers[name] = reason.strip()
    return waivers


# Durations


def parse_duration(what: str, text: str, example: str) -> timedelta:
    """Return the duration for a text that a user has typed, such as `90min` or `2 s`.

    Args:
        what: Name of the option or argument, for the error message.
        text: Number and unit, or several numbers with units: `1h30min`.
        example: Example of a valid option, for the hint.

    Raises:
        SpecError: The text is not a duration.
    """
    from hil.core import duration_of

    try:
        return duration_of(text.replace(" ", ""))
    except ValueError as error:
        raise SpecError(f"{what} {error}", hint=f"for example: {example}") from None
