"""Load experiments and stations: everything that is wrong with a file, in one error."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import ValidationError

from hil.core import (
    MOST_PROBLEMS,
    Problem,
    Source,
    SpecError,
    did_you_mean,
    dotted,
    parse,
    read_source,
    refuse,
    shown,
)
from hil.spec.checks import (
    check_estimators,
    check_interlocks,
    check_pose_file,
    check_robots,
    check_studies,
    is_path,
)
from hil.spec.experiment import Dwell, ExperimentSpec
from hil.spec.field_types import Strict
from hil.spec.findings import findings_of
from hil.spec.hashing import spec_hash
from hil.spec.messages import explain
from hil.spec.model_tree import key_above
from hil.spec.overrides import lay_over
from hil.spec.station import Station, StationRobot

__all__ = ["load_spec", "load_station", "resolve_robot", "spec_from_text", "spec_hash"]

M = TypeVar("M", bound=Strict)

_NO_OVERRIDES: Mapping[str, str] = {}


def load_spec(
    file: str | FilePath | Source,
    overrides: Mapping[str, str] = _NO_OVERRIDES,
    *,
    look_up: bool = True,
) -> ExperimentSpec:
    """Read an experiment.

    Args:
        file: The YAML file, or what `read_source` read from it, which is changed.
        overrides: Values laid over the file, YAML text by dotted path (`excitation.waypoints`).
        look_up: Check that the estimators, interlocks and files the spec names exist here. Switch
            it off to read the spec of a run that was made elsewhere.

    Returns:
        The spec; `excitation.file` is absolute.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    return _spec(source, FilePath(source.name).parent, overrides, look_up)


def spec_from_text(
    text: str,
    name: str = "<text>",
    overrides: Mapping[str, str] = _NO_OVERRIDES,
    *,
    folder: str | FilePath = ".",
    look_up: bool = True,
) -> ExperimentSpec:
    """Read an experiment from YAML text; relative paths in it start at `folder`.

    Raises:
        SpecError: As `load_spec`, with `name` in place of the file.
    """
    return _spec(parse(text, name), FilePath(folder), overrides, look_up)


def load_station(path: str | FilePath, *, look_up: bool = True) -> Station:
    """Read a station.

    Args:
        path: The YAML file.
        look_up: Check that the drivers and models it names exist here.

    Returns:
        The station; robot models that are paths are absolute.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every problem.
    """
    source, folder = read_source(path, "hil_station"), FilePath(path).parent
    refuse_other_kind(source, "hil_station")
    if look_up:
        check_robots(source, folder)
    _make_absolute(source, folder)
    return validated(source, Station)


def resolve_robot(spec: ExperimentSpec, station: Station) -> StationRobot:
    """The robot of the station that the experiment asks for.

    Raises:
        SpecError: The station has no robot of that name.
    """
    robot = station.robots.get(spec.robot)
    if robot is None:
        raise SpecError(
            f"robot: the station {station.name!r} has no robot {spec.robot!r}, "
            f"which the experiment {spec.name!r} asks for",
            hint=did_you_mean(spec.robot, station.robots) + " (or choose another --station)",
        )
    return robot


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
        told = _with_overrides(error.message, as_written, folder, overrides, look_up)
        raise SpecError(told, hint=error.hint) from None


def _with_overrides(
    told: str, as_written: Source, folder: FilePath, overrides: Mapping[str, str], look_up: bool
) -> str:
    """The lines of an error, with the overrides where the file as written has none such."""
    try:
        _checked(as_written, folder, look_up)
        before = set()
    except SpecError as error:
        before = set(error.message.splitlines())
    laid = ", ".join(f"{shown(key)}={shown(text)}" for key, text in overrides.items())
    return "\n".join(
        f"{line} (with --set {laid})"
        if line.startswith(f"{as_written.name}:") and line not in before
        else line
        for line in told.splitlines()
    )


def _checked(source: Source, folder: FilePath, look_up: bool) -> ExperimentSpec:
    """The spec of what a file says."""
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


def validated(source: Source, model: type[M]) -> M:
    """The model, or one error with the problems of YAML, of look-ups and of the model together."""
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
    """Of the first section with a problem; where all are at the top, of the whole file."""
    for problem in sorted(problems, key=lambda problem: problem.mark):
        if len(problem.path) > 1 and (section := key_above(problem.path, model)):
            return f"`hil explain {dotted(section)}` lists what may stand there"
    kind = model.__name__.removesuffix("Spec").lower()  # one that `hil schema` knows
    return f"`hil schema {kind}` lists every key with its unit and meaning"


_KINDS = {
    "hil": "an experiment",
    "hil_station": "a station",
    "hil_map": "an import map",
    "hil_series": "a series of experiments",
    "hil_schedule": "a schedule",
    "hil_fleet": "the robots of a fleet",
    "capsules": "the description of an arm",
}
_USES = {
    "hil": "hil run FILE",
    "hil_station": "hil run SPEC --station FILE",
    "hil_map": "hil import RECORDING --map FILE -o OUT",
    "hil_series": "hil run FILE",
    "hil_schedule": "hil schedule plan FILE, hil schedule run FILE, hil reidentify FILE",
    "hil_fleet": "hil fleet run SPEC --robots FILE",
    "capsules": "the robots of a station, as `model: FILE`",
}


def refuse_other_kind(source: Source, wanted: str) -> None:
    """One sentence instead of dozens for a station given as an experiment, and the like."""
    data: Any = source.data
    if not isinstance(data, dict):
        message = f"must be a mapping that begins with `{wanted}: 1`"
        raise refuse([Problem(source.mark(()), (), message)])
    if key := _other_kind(data, wanted):
        message = f"this file is {_KINDS[key]}, but {_KINDS[wanted]} is needed here"
        hint = f"this one is for: {_USES[key]}"
        raise refuse([Problem(source.mark((key,), key=True), (), message)], hint=hint)


def no_such_kind(file: FilePath, wanted: str) -> str:
    """What is wrong with naming a file where another kind is needed; empty when nothing is.

    Whatever else is wrong with the file is told by whoever reads it.
    """
    try:
        data = read_source(file).data
    except SpecError:
        return ""
    key = _other_kind(data, wanted)
    return f"{file} is {_KINDS[key]}, but {_KINDS[wanted]} is needed here" if key else ""


def _other_kind(data: Any, wanted: str) -> str:
    """The key that says that a file is of another kind; empty when it may be what is wanted."""
    known = data if isinstance(data, dict) and wanted not in data else {}
    return next((key for key in _KINDS if key in known), "")


def _make_absolute(source: Source, folder: FilePath) -> None:
    robots = source.at(("robots",))
    for robot in robots.values() if isinstance(robots, dict) else ():
        model = robot.get("model") if isinstance(robot, dict) else None
        if isinstance(model, str) and is_path(model):
            robot["model"] = str((folder / model).resolve())
