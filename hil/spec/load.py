"""Load experiments and stations; one error lists everything that is wrong with a file.

A file is parsed, values from the command line (`--set excitation.waypoints=12`) are laid over it,
and what it names outside itself (estimators, studies, interlocks, drivers, arms, files) is looked
up. These checks read the parsed data and not the validated model, so that their findings come in
the same report as everything else that is wrong with the file.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import ValidationError

from hil.arms import arm_names
from hil.core import (
    MOST_PROBLEMS,
    HilError,
    KeyPath,
    PluginError,
    Problem,
    Source,
    SpecError,
    closest,
    did_you_mean,
    dotted,
    no_file_but,
    parse,
    plugins,
    read_source,
    refuse,
    shown,
    yaml_text,
)
from hil.spec.errors import explain, findings_of
from hil.spec.experiment import Dwell, ExperimentSpec
from hil.spec.field_types import Strict
from hil.spec.interlocks import INTERLOCK_KINDS
from hil.spec.model_tree import key_above
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
        file: The YAML file, or what `read_source` read from it, which is changed.
        overrides: Values laid over the file, YAML text by dotted path (`excitation.waypoints`).
        look_up: Check that the estimators, studies, interlocks and files the spec names exist
            here. Switch it off to read the spec of a run that was made elsewhere.

    Returns:
        The spec; `excitation.file` is absolute.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every problem.
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


def _with_overrides(
    message: str, as_written: Source, folder: FilePath, overrides: Mapping[str, str], look_up: bool
) -> str:
    """Return the lines of an error; those the file as written does not have name the overrides."""
    before: set[str] = set()
    try:
        _checked(as_written, folder, look_up)
    except SpecError as error:
        before = set(error.message.splitlines())
    if len(before) > MOST_PROBLEMS:  # the list is cut off: any line may be an old one
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
    _make_models_absolute(source, folder)
    return validated(source, Station)


def _make_models_absolute(source: Source, folder: FilePath) -> None:
    """Make the robot models of a station absolute that are paths."""
    robots = source.at(("robots",))
    for robot in robots.values() if isinstance(robots, dict) else ():
        model = robot.get("model") if isinstance(robot, dict) else None
        if isinstance(model, str) and is_path(model):
            robot["model"] = str((folder / model).resolve())


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


M = TypeVar("M", bound=Strict)


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
"""Key that a file has → what such a file is, and what it is for."""


def is_kind(file: str | FilePath | Source, key: str) -> bool:
    """Return whether a file, or what was read from it, has a kind's key; an unreadable one not."""
    try:
        data = file.data if isinstance(file, Source) else read_source(file).data
    except SpecError:
        return False
    return isinstance(data, dict) and key in data


def refuse_other_kind(source: Source, wanted: str) -> None:
    """Refuse a file of another kind in one sentence instead of dozens of findings.

    Raises:
        SpecError: The file is of another kind, or no mapping.
    """
    data: Any = source.data
    if not isinstance(data, dict):
        message = f"must be a mapping that begins with `{wanted}: 1`"
        raise refuse([Problem(source.mark(()), (), message)])
    if key := _other_kind(data, wanted):
        kind, use = _KINDS[key]
        message = f"this file is {kind}, but {_KINDS[wanted][0]} is needed here"
        problem = Problem(source.mark((key,), key=True), (), message)
        raise refuse([problem], hint=f"this one is for: {use}")


def _other_kind(data: Any, wanted: str) -> str:
    """The key that says that a file is of another kind; empty when it may be what is wanted."""
    known = data if isinstance(data, dict) and wanted not in data else {}
    return next((key for key in _KINDS if key in known), "")


def wrong_kind(file: FilePath, wanted: str) -> str:
    """Return the message for a file of another kind than needed; empty for one that may be right.

    Other problems of the file are reported when it is loaded.
    """
    try:
        data = read_source(file).data
    except SpecError:
        return ""
    key = _other_kind(data, wanted)
    return f"{file} is {_KINDS[key][0]}, but {_KINDS[wanted][0]} is needed here" if key else ""


def make_absolute(source: Source, place: KeyPath, folder: FilePath) -> None:
    """Make a path absolute that starts at the folder of its file; note it if there is no such file.

    Args:
        source: Problems are added to it.
        place: Where the path is; its last key is `station`, or something that is an experiment.
        folder: Of the file.
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


def lay_over(source: Source, overrides: Mapping[str, str]) -> None:
    """Set values in a parsed file; each is YAML, its key the dotted path (`loads.0.mass_kg`).

    Mappings on the way are made as needed, also in place of null; lists must be long enough, or may
    be replaced whole. Problems are collected in the source, under the name `--set N`.

    Raises:
        SpecError: A value is not YAML, there is no such place, or one would undo another.
    """
    _require_apart(list(overrides))
    for number, (dotted_key, text) in enumerate(overrides.items(), 1):
        name = f"--set {number}"
        told = f"{name}: {shown(dotted_key)}"
        value = parse(text, told) if text.strip() else Source(told)
        source.problems += value.problems
        path = _path_in(source.data, dotted_key)
        if why := "a step of it is empty" if "" in path else _set(source.data, path, value.data):
            message = f"{told}: there is no such place in {source.name}: {why}"
            raise SpecError(message, hint="a path is dotted, such as loads.0.mass_kg")
        source.replaced(path, name)


def _require_apart(dotted_keys: list[str]) -> None:
    """No path twice and none below another: the last would undo what the first is said to be."""
    paths = [_comparable(key) for key in dotted_keys]
    for second, path in enumerate(paths):
        for first, other in enumerate(paths[:second]):
            shorter = min(len(path), len(other))
            if path[:shorter] != other[:shorter]:
                continue
            longer = "would change" if len(path) > len(other) else "is"
            does = "would replace" if len(path) < len(other) else longer
            raise SpecError(
                f"--set {second + 1}: {shown(dotted_keys[second])}: {does} "
                f"{shown(dotted_keys[first])} of --set {first + 1}",
                hint="give each path once, and none below another: put both into one value",
            )


def _comparable(dotted_key: str) -> tuple[str, ...]:
    """Steps of a path, an index always written the same."""
    return tuple(
        step.lstrip("0") or "0" if _is_index(step) else step for step in dotted_key.split(".")
    )


def _is_index(step: str) -> bool:
    return step.isascii() and step.isdigit()


def _path_in(data: Any, dotted_key: str) -> KeyPath:
    path: list[str | int] = []
    for step in dotted_key.split("."):
        is_index = isinstance(data, list) and _is_index(step)
        path.append(int(step.lstrip("0")[:9] or "0") if is_index else step)
        data = _child(data, path[-1])
    return tuple(path)


def _child(data: Any, step: str | int) -> Any:
    if isinstance(data, dict):
        return data.get(step)
    if isinstance(data, list) and isinstance(step, int) and step < len(data):
        return data[step]
    return None


def _set(data: Any, path: KeyPath, value: Any) -> str:
    """Put `value` at `path`; why not, where a list or a plain value is in the way."""
    for step in path[:-1]:
        if not _has_place(data, step):
            return _in_the_way(data, step)
        if _child(data, step) is None:
            data[step] = {}
        data = data[step]
    if not _has_place(data, path[-1]):
        return _in_the_way(data, path[-1])
    data[path[-1]] = value
    return ""


def _has_place(data: Any, step: str | int) -> bool:
    """Return whether `data` is a mapping, or a list that has the entry `step`; it may be null."""
    if isinstance(data, list):
        return isinstance(step, int) and step < len(data)
    return isinstance(data, dict)


def _in_the_way(data: Any, step: str | int) -> str:
    if isinstance(data, list):
        known = f"entries 0 to {len(data) - 1}" if data else "no entries"
        return f"there is a list with {known}, not {shown(step)}"
    return f"{shown(step)} would be below {shown(data)}"


def resolved_text(path: FilePath, overrides: Mapping[str, str]) -> str:
    """A file as it is with its overrides: YAML without its comments, but with a word of those.

    Raises:
        SpecError: The file cannot be read, or an override cannot be laid over it.
    """
    source = read_source(path)
    lay_over(source, overrides)
    said = "".join(
        f"#   --set {shown(key, 300)}={shown(text, 300)}\n" for key, text in overrides.items()
    )
    return f"# {path.name}, with\n{said}{yaml_text(source.data)}"


def check_estimators(source: Source) -> None:
    """Names under `fit` must be estimators for this excitation, keys beside them their parameters.

    The estimators are imported: one that cannot be is found here, and not after hours of motion.
    """
    for path, entry in _entries(source, "fit"):
        _check_named(source, path, entry, "estimator", "hil.estimators")


def _entries(source: Source, key: str) -> Iterator[tuple[KeyPath, dict[str, Any]]]:
    """The mappings in a list or mapping at the top of the file, with their paths."""
    group = source.at((key,))
    if isinstance(group, dict):
        steps: list[tuple[str | int, Any]] = list(group.items())
    else:
        steps = list(enumerate(group)) if isinstance(group, list) else []
    return (((key, step), entry) for step, entry in steps if isinstance(entry, dict))


def _check_named(
    source: Source, path: KeyPath, entry: dict[str, Any], word: str, group: str
) -> None:
    """An entry whose key `word` names a plug-in and whose other keys are its parameters."""
    name = entry.get(word)
    if not isinstance(name, str):
        return
    if name not in (known := plugins.names(group)):
        options = did_you_mean(name, known) if known else "none is installed"
        source.add((*path, word), f"there is no {word} '{shown(name)}'; {options}")
        return
    try:
        plugin = plugins.load(group, name)
    except PluginError as error:
        source.add((*path, word), f"{error.message} → {error.hint}")
        return
    _check_excitation(source, (*path, word), name, plugin)
    given = {key: value for key, value in entry.items() if key != word}
    _check_parameters(source, (*path, word), name, given, plugin)


RECORDED = {"dwell": ("dwell", "dwells"), "fourier": ("trajectory", "trajectories")}
"""Kind of excitation → the series it is run for, singular as in the data and plural for people."""


def _check_excitation(source: Source, path: KeyPath, name: str, plugin: Any) -> None:
    """The program must record what it is made for; the moves in between do not count.

    An estimator that can make do with other series does so on recordings of other origin
    (`hil fit`), where there is nothing better. In a program of its own it would be starved: a
    Fourier program stands still at the ends of its trajectories only, and the moves of a dwell
    program are no trajectories that could be held out.
    """
    kind = source.at(("excitation", "kind"))
    kinds = getattr(plugin, "series_kinds", ())
    if not (isinstance(kind, str) and kind in RECORDED and kinds):
        return
    recorded, plural = RECORDED[kind]
    if recorded not in kinds[0]:
        wanted = " or ".join(f"kind: {k}" for k, (r, _) in RECORDED.items() if r in kinds[0])
        message = f"{name} cannot use the {plural} of this excitation"
        source.add(path, f"{message}; it needs {wanted or ', '.join(kinds[0])}")


def _check_parameters(
    source: Source, named: KeyPath, name: str, given: dict[str, Any], plugin: Any
) -> None:
    """Check the parameters of a plug-in whose name is at `named`, beside them."""
    path, known = named[:-1], _keywords(plugin)
    unknown = [key for key in given if known is not None and key not in known]
    for key in unknown:
        source.add((*path, key), _no_parameter(name, key, known or []), key=True)
    if unknown:
        return
    if lacking := [key for key in _required(plugin) if key not in given]:
        source.add(named, f"{name} needs {', '.join(lacking)}")
    elif given:
        _check_values(source, path, plugin, given)


_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


def _keywords(plugin: Any, after: int = 0) -> list[str] | None:
    """Return the names of keyword parameters, or None when the plug-in takes any.

    Args:
        plugin: A class or function.
        after: So many parameters at the beginning are left out.
    """
    parameters = _signature(plugin)
    if parameters is None or any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    return [p.name for p in parameters[after:] if p.kind in _NAMED]


def _required(plugin: Any, after: int = 0) -> list[str]:
    """Return the names of parameters without default; arguments as in `_keywords`."""
    named = (inspect.Parameter.POSITIONAL_ONLY, *_NAMED)
    parameters = (_signature(plugin) or [])[after:]
    return [p.name for p in parameters if p.kind in named and p.default is p.empty]


def _signature(plugin: Any) -> list[inspect.Parameter] | None:
    """Return all parameters of a plug-in, or None where they cannot be read."""
    try:
        return list(inspect.signature(plugin).parameters.values())
    except (TypeError, ValueError):
        return None


def _no_parameter(name: str, key: str, known: list[str]) -> str:
    message = f"{name} has no parameter '{shown(key)}'"
    if not known:
        return f"{message}; it takes none"
    if match := closest(key, known):
        message += f"; did you mean {match!r}?"
    return f"{message} (it has {', '.join(known)})"


def _check_values(source: Source, path: KeyPath, plugin: Any, given: dict[str, Any]) -> None:
    """Let the constructor judge its parameters; by contract it does no work."""
    try:
        plugin(**given)
    except Exception as error:
        told = _first_line(error)
        culprit = next((key for key in given if re.match(rf"{re.escape(key)}\b", told)), None)
        source.add((*path, culprit) if culprit else path, told)


def _first_line(error: Exception) -> str:
    """What a constructor complains about, in one line that begins with the parameter."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return ": ".join((".".join(str(step) for step in first["loc"]), first["msg"]))
    message = error.message if isinstance(error, HilError) else str(error)
    line = shown(message.partition("\n")[0] or type(error).__name__, most=300)
    hint = error.hint if isinstance(error, HilError) else ""
    return f"{line} → {hint}" if hint else line


def check_studies(source: Source) -> None:
    """Names under `study` must be studies of such a run, keys beside them their parameters."""
    for path, entry in _entries(source, "study"):
        _check_named(source, path, entry, "study", "hil.studies")


def check_interlocks(source: Source) -> None:
    """Kinds under `interlocks` must be built in or plug-ins, keys beside them their parameters.

    A plug-in is imported: one that cannot be is found here, and not with the robot switched on.
    """
    for path, entry in _entries(source, "interlocks"):
        kind = entry.get("kind")
        if not isinstance(kind, str) or kind in INTERLOCK_KINDS:
            continue
        if kind not in (plugged := plugins.names("hil.interlocks")):
            close = did_you_mean(kind, [*INTERLOCK_KINDS, *plugged])
            source.add((*path, "kind"), f"there is no kind '{shown(kind)}'; {close}")
        else:
            _check_plugged(source, path, kind, entry)


def _check_plugged(source: Source, path: KeyPath, kind: str, entry: dict[str, Any]) -> None:
    try:
        plugin = plugins.load("hil.interlocks", kind)
    except PluginError as error:
        source.add((*path, "kind"), f"{error.message} → {error.hint}")
        return
    # The first parameter is its context; the spec itself knows the others.
    known, unknown = _keywords(plugin, after=1), []
    if known is not None:
        own = [name for name in known if name != "action"]
        unknown = [key for key in entry if key not in ("kind", "action", "enabled", *own)]
        for key in unknown:
            source.add((*path, key), _no_parameter(kind, key, own), key=True)
    lacking = [name for name in _required(plugin, after=1) if name not in (*entry, "action")]
    if lacking and not unknown:  # else it is there under a name that was mistyped
        source.add((*path, "kind"), f"{kind} needs {', '.join(lacking)}")


def check_robots(source: Source, folder: FilePath) -> None:
    """Drivers must be registered, models be built-in arms or existing files.

    Such a file is a URDF or the description of an arm.
    """
    known = plugins.names("hil.drivers")
    for path, robot in _entries(source, "robots"):
        driver, model = robot.get("driver"), robot.get("model")
        if isinstance(driver, str) and driver not in known:
            message = f"there is no driver '{shown(driver)}'; {did_you_mean(driver, known)}"
            source.add((*path, "driver"), message)
        if isinstance(model, str) and (message := _fault_of_model(model, folder)):
            source.add((*path, "model"), message)


def _fault_of_model(model: str, folder: FilePath) -> str:
    if is_path(model):
        return "" if is_file(folder / model) else _missing(folder / model)
    if model in arm_names():
        return ""
    hint = did_you_mean(model, arm_names())
    end = "" if hint.endswith("?") else "."
    return f"there is no built-in arm '{shown(model)}'; {hint}{end} A URDF is named by its path."


def _missing(path: FilePath) -> str:
    """Return the message for a missing file, with suggestions of the same ending."""
    return no_file_but(path, [path.suffix.casefold()])


def check_pose_file(source: Source, folder: FilePath) -> None:
    """The file of poses that a dwell program names must exist."""
    path: KeyPath = ("excitation", "file")
    file = source.at(path)
    if isinstance(file, str) and not is_file(folder / file):
        source.add(path, _missing(folder / file))


PATHS = (".urdf", ".xml", ".yaml", ".yml")
"""Endings of models that are files: a URDF, or a description of an arm."""


def is_path(model: str) -> bool:
    """True when a robot's `model` is a path and not the name of a built-in arm."""
    return "/" in model or "\\" in model or model.casefold().endswith(PATHS)


def is_file(path: FilePath) -> bool:
    """True for an existing file; names no file system takes are none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
