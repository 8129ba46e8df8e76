"""Loading of experiments and stations; one error lists all problems of a file.

Loading a file has four steps: the file is parsed, overrides from the command line are applied
(`overrides`), names of external objects are looked up (`look_up`), and a model validates the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import ValidationError

from hil.core import (
    MOST_PROBLEMS,
    KeyPath,
    Problem,
    Source,
    SpecError,
    did_you_mean,
    dotted,
    no_file_but,
    parse,
    read_source,
    refuse,
    shown,
)
from hil.spec.errors import explain, findings_of
from hil.spec.experiment import Dwell, ExperimentSpec
from hil.spec.field_types import Strict
from hil.spec.look_up import (
    check_estimators,
    check_interlocks,
    check_pose_file,
    check_robots,
    check_studies,
    is_file,
    is_path,
)
from hil.spec.model_tree import key_above
from hil.spec.overrides import lay_over
from hil.spec.station import Station, StationRobot

_NO_OVERRIDES: Mapping[str, str] = {}


def load_spec(
    file: str | FilePath | Source,
    overrides: Mapping[str, str] = _NO_OVERRIDES,
    *,
    look_up: bool = True,
) -> ExperimentSpec:
    """Read an experiment.

    Args:
        file: YAML file, or the source that `read_source` read from the file; the source is
            modified.
        overrides: Overrides of the file as YAML text by dotted path (`excitation.waypoints`).
        look_up: Whether to check that the estimators, studies, interlocks and files in the spec
            exist on this computer; False if the spec belongs to a run from a different computer.

    Returns:
        Validated spec of the experiment, in which `excitation.file` is an absolute path.

    Raises:
        SpecError: The file has problems; the message has one line `file:line:column: path: message`
            per problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    return _spec(source, FilePath(source.name).parent, overrides, look_up)


def _spec(
    source: Source, folder: FilePath, overrides: Mapping[str, str], look_up: bool
) -> ExperimentSpec:
    refuse_other_kind(source, "hil")
    as_written = deepcopy(source) if overrides else source
    lay_over(source, overrides)
    try:
        return _checked(source, folder, look_up)
    except SpecError as error:
        if not overrides:
            raise
        message = _with_overrides(error.message, as_written, folder, overrides, look_up)
        raise SpecError(message, hint=error.hint) from None


def _checked(source: Source, folder: FilePath, look_up: bool) -> ExperimentSpec:
    """Return the validated spec of a parsed file."""
    if look_up:
        check_estimators(source)
        check_studies(source)
        check_interlocks(source)
        check_pose_file(source, folder)
    spec = validated(source, ExperimentSpec)
    excitation = spec.excitation
    if not isinstance(excitation, Dwell) or excitation.file is None:
        return spec
    file = str((folder / excitation.file).resolve())
    return spec.model_copy(update={"excitation": excitation.model_copy(update={"file": file})})


def _with_overrides(
    message: str, as_written: Source, folder: FilePath, overrides: Mapping[str, str], look_up: bool
) -> str:
    """Return the lines of an error message; lines about overridden values name the overrides."""
    before: set[str] = set()
    try:
        _checked(as_written, folder, look_up)
    except SpecError as error:
        before = set(error.message.splitlines())
    if len(before) > MOST_PROBLEMS:  # truncated: a line may be due to the file itself
        return message
    laid = ", ".join(f"{shown(key)}={shown(text)}" for key, text in overrides.items())
    return "\n".join(
        f"{line} (with --set {laid})"
        if line.startswith(f"{as_written.name}:") and line not in before
        else line
        for line in message.splitlines()
    )


def spec_from_text(
    text: str,
    name: str = "<text>",
    overrides: Mapping[str, str] = _NO_OVERRIDES,
    *,
    folder: str | FilePath = ".",
    look_up: bool = True,
) -> ExperimentSpec:
    """Read an experiment from YAML text; relative paths in the text start at `folder`.

    Raises:
        SpecError: The text has problems, as for `load_spec`; the message contains `name` instead of
            the file name.
    """
    return _spec(parse(text, name), FilePath(folder), overrides, look_up)


def load_station(path: str | FilePath, *, look_up: bool = True) -> Station:
    """Read a station.

    Args:
        path: YAML file.
        look_up: Whether to check that the drivers and models in the file exist on this computer.

    Returns:
        Validated station, in which the paths of robot models are absolute.

    Raises:
        SpecError: The file has problems; the message has one line `file:line:column: path: message`
            per problem.
    """
    source, folder = read_source(path, "hil_station"), FilePath(path).parent
    refuse_other_kind(source, "hil_station")
    if look_up:
        check_robots(source, folder)
    _make_models_absolute(source, folder)
    return validated(source, Station)


def _make_models_absolute(source: Source, folder: FilePath) -> None:
    """Convert the paths of a station's robot models to absolute paths."""
    robots = source.at(("robots",))
    for robot in robots.values() if isinstance(robots, dict) else ():
        model = robot.get("model") if isinstance(robot, dict) else None
        if isinstance(model, str) and is_path(model):
            robot["model"] = str((folder / model).resolve())


def resolve_robot(spec: ExperimentSpec, station: Station) -> StationRobot:
    """Return the station entry of the robot that the experiment names.

    Raises:
        SpecError: The station has no robot with this name.
    """
    robot = station.robots.get(spec.robot)
    if robot is None:
        raise SpecError(
            f"robot: the station {station.name!r} has no robot {spec.robot!r}, "
            f"which the experiment {spec.name!r} requires",
            hint=did_you_mean(spec.robot, station.robots) + " (or choose a different --station)",
        )
    return robot


M = TypeVar("M", bound=Strict)


def validated(source: Source, model: type[M]) -> M:
    """Return the model that validates the data of a source.

    Raises:
        SpecError: The source has YAML, look-up or validation problems; the message lists all
            problems.
    """
    try:
        spec = model.model_validate(source.data)
    except ValidationError as error:
        findings = findings_of(error.errors(include_url=False), model, source)
        problems = [explain(finding, model, source) for finding in findings[:MOST_PROBLEMS]]
        more = len(findings) - len(problems)
        hint = _where_to_read(problems, model)
        raise refuse(source.problems + problems, hint=hint, more=more) from None
    if source.problems:
        raise refuse(source.problems)
    return spec


def _where_to_read(problems: list[Problem], model: type[Strict]) -> str:
    """Return a hint to the documentation of the first section with a problem.

    If all problems are at the top level, the hint is about the whole file.
    """
    for problem in sorted(problems, key=lambda problem: problem.mark):
        if len(problem.path) > 1 and (section := key_above(problem.path, model)):
            return f"`hil explain {dotted(section)}` lists the allowed keys and values"
    kind = model.__name__.removesuffix("Spec").lower()  # one that `hil schema` knows
    return f"`hil schema {kind}` lists every key with its unit and meaning"


_KINDS = {
    "hil": ("an experiment", "hil run FILE"),
    "hil_station": ("a station", "hil run SPEC --station FILE"),
    "hil_map": ("an import map", "hil import RECORDING --map FILE -o OUT"),
    "hil_series": ("a series of experiments", "hil run FILE"),
    "hil_schedule": (
        "a schedule",
        "hil schedule plan FILE, hil schedule run FILE, hil reidentify FILE",
    ),
    "hil_fleet": ("the robots of a fleet", "hil fleet run SPEC --robots FILE"),
    "capsules": ("the description of an arm", "the robots of a station, as `model: FILE`"),
}
"""Description and use of each kind of YAML file, by the key that identifies the kind."""


def is_kind(file: str | FilePath | Source, key: str) -> bool:
    """Return whether a file, or its source, has the key of a kind; False if it is unreadable."""
    try:
        data = file.data if isinstance(file, Source) else read_source(file).data
    except SpecError:
        return False
    return isinstance(data, dict) and key in data


def refuse_other_kind(source: Source, wanted: str) -> None:
    """Raise an error with a single sentence if a file is of a different kind.

    Without this check, a file of a wrong kind would give dozens of validation errors.

    Raises:
        SpecError: The file is of a different kind, or is not a mapping.
    """
    data: Any = source.data
    if not isinstance(data, dict):
        message = f"must be a mapping that begins with `{wanted}: 1`"
        raise refuse([Problem(source.mark(()), (), message)])
    if key := _other_kind(data, wanted):
        kind, use = _KINDS[key]
        message = f"this file is {kind}, but {_KINDS[wanted][0]} is needed here"
        problem = Problem(source.mark((key,), key=True), (), message)
        raise refuse([problem], hint=f"use this file with: {use}")


def _other_kind(data: Any, wanted: str) -> str:
    """Return the key that identifies a file as a different kind; empty if there is none."""
    known = data if isinstance(data, dict) and wanted not in data else {}
    return next((key for key in _KINDS if key in known), "")


def wrong_kind(file: FilePath, wanted: str) -> str:
    """Return the message for a file of a different kind; empty if the kind may be right.

    All problems other than a wrong kind are reported when the file is loaded.
    """
    try:
        data = read_source(file).data
    except SpecError:
        return ""
    key = _other_kind(data, wanted)
    return f"{file} is {_KINDS[key][0]}, but {_KINDS[wanted][0]} is needed here" if key else ""


def make_absolute(source: Source, place: KeyPath, folder: FilePath) -> None:
    """Convert a path that is relative to its file to an absolute path.

    If the named file does not exist or is of a different kind, a problem is added to the source.

    Args:
        source: Source of the file, to which problems are added.
        place: Location of the path in the file; its last key is `station`, or a key that names an
            experiment.
        folder: Folder of the file, at which relative paths start.
    """
    named, holder = source.at(place), source.at(place[:-1])
    if not isinstance(named, str) or not isinstance(holder, dict):
        return
    file = folder / named
    if not is_file(file):
        source.add(place, no_file_but(file, (".yaml", ".yml")))
        return
    if wrong := wrong_kind(file, "hil_station" if place[-1] == "station" else "hil"):
        source.add(place, wrong)
    holder[place[-1]] = str(file.resolve())
