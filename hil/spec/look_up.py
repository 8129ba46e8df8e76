"""Look-up of external objects that an experiment or a station names.

External objects are estimators, studies, interlocks, drivers, arms and files. The look-up checks
read the parsed data instead of the validated model, so that their problems are reported together
with all other problems of the file.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any

from pydantic import ValidationError

from hil.arms import arm_names
from hil.core import (
    HilError,
    KeyPath,
    PluginError,
    Source,
    closest,
    did_you_mean,
    no_file_but,
    plugins,
    shown,
)
from hil.spec.interlocks import INTERLOCK_KINDS


def check_estimators(source: Source) -> None:
    """Check that names under `fit` are estimators for this excitation, with valid parameters.

    The estimators are imported in this check, so that an estimator that cannot be imported is
    reported before hours of motion.
    """
    for path, entry in _entries(source, "fit"):
        _check_named(source, path, entry, "estimator", "hil.estimators")


def _entries(source: Source, key: str) -> Iterator[tuple[KeyPath, dict[str, Any]]]:
    """Return the mappings in a list or mapping at the top level of the file, with their paths."""
    group = source.at((key,))
    if isinstance(group, dict):
        steps: list[tuple[str | int, Any]] = list(group.items())
    else:
        steps = list(enumerate(group)) if isinstance(group, list) else []
    return (((key, step), entry) for step, entry in steps if isinstance(entry, dict))


def _check_named(
    source: Source, path: KeyPath, entry: dict[str, Any], word: str, group: str
) -> None:
    """Check an entry whose key `word` names a plug-in and whose other keys are its parameters."""
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
"""Name of the recorded series by kind of excitation: singular as in the data, plural for
messages."""


def _check_excitation(source: Source, path: KeyPath, name: str, plugin: Any) -> None:
    """Check that the program records the kind of series for which the plug-in was designed.

    Recorded moves between poses or trajectories are ignored in this check. An estimator that also
    accepts other kinds of series may use them in recordings from other sources (`hil fit`), because
    such recordings contain no better data. In a program for this estimator, the other kinds of
    series would provide too little data: a Fourier program is at standstill only at the ends of its
    trajectories, and the moves of a dwell program are not trajectories that could be held out.
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
    """Check the parameters beside the name of a plug-in, which is at the path `named`."""
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
    """Return the names of the keyword parameters; None if the plug-in accepts any keyword.

    Args:
        plugin: Class or function of the plug-in.
        after: Number of leading parameters that are left out.
    """
    parameters = _signature(plugin)
    if parameters is None or any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    return [p.name for p in parameters[after:] if p.kind in _NAMED]


def _required(plugin: Any, after: int = 0) -> list[str]:
    """Return the names of the parameters without default; see `_keywords` for the arguments."""
    named = (inspect.Parameter.POSITIONAL_ONLY, *_NAMED)
    parameters = (_signature(plugin) or [])[after:]
    return [p.name for p in parameters if p.kind in named and p.default is p.empty]


def _signature(plugin: Any) -> list[inspect.Parameter] | None:
    """Return all parameters of a plug-in; None if its signature is not available."""
    try:
        return list(inspect.signature(plugin).parameters.values())
    except (TypeError, ValueError):
        return None


def _no_parameter(name: str, key: str, known: list[str]) -> str:
    message = f"{name} has no parameter '{shown(key)}'"
    if not known:
        return f"{message}; it has no parameters"
    if match := closest(key, known):
        message += f"; did you mean {match!r}?"
    return f"{message} (it has {', '.join(known)})"


def _check_values(source: Source, path: KeyPath, plugin: Any, given: dict[str, Any]) -> None:
    """Check parameters by calling the constructor, which must not do other work."""
    try:
        plugin(**given)
    except Exception as error:
        line = _first_line(error)
        culprit = next((key for key in given if re.match(rf"{re.escape(key)}\b", line)), None)
        source.add((*path, culprit) if culprit else path, line)


def _first_line(error: Exception) -> str:
    """Return the error of a constructor as one line that begins with the name of the parameter."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return ": ".join((".".join(str(step) for step in first["loc"]), first["msg"]))
    message = error.message if isinstance(error, HilError) else str(error)
    line = shown(message.partition("\n")[0] or type(error).__name__, most=300)
    hint = error.hint if isinstance(error, HilError) else ""
    return f"{line} → {hint}" if hint else line


def check_studies(source: Source) -> None:
    """Check that names under `study` are studies for such a run, with valid parameters."""
    for path, entry in _entries(source, "study"):
        _check_named(source, path, entry, "study", "hil.studies")


def check_interlocks(source: Source) -> None:
    """Check that kinds under `interlocks` are built in or plug-ins, with valid parameters.

    The plug-in of an interlock is imported in this check, so that an import error is reported
    before the robot is switched on.
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
    # The first parameter of a plug-in is its context; the model of the spec has the others.
    known, unknown = _keywords(plugin, after=1), []
    if known is not None:
        own = [name for name in known if name != "action"]
        unknown = [key for key in entry if key not in ("kind", "action", "enabled", *own)]
        for key in unknown:
            source.add((*path, key), _no_parameter(kind, key, own), key=True)
    lacking = [name for name in _required(plugin, after=1) if name not in (*entry, "action")]
    if lacking and not unknown:  # otherwise a required key is probably mistyped
        source.add((*path, "kind"), f"{kind} needs {', '.join(lacking)}")


def check_robots(source: Source, folder: FilePath) -> None:
    """Check that drivers are registered, and that models are built-in arms or existing files.

    A model file is a URDF or the description of an arm.
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
    return f"there is no built-in arm '{shown(model)}'; {hint}{end} Write the path of a URDF."


def _missing(path: FilePath) -> str:
    """Return the message for a missing file, with suggestions of files with the same suffix."""
    return no_file_but(path, [path.suffix.casefold()])


def check_pose_file(source: Source, folder: FilePath) -> None:
    """Check that the waypoint file of a dwell program exists."""
    path: KeyPath = ("excitation", "file")
    file = source.at(path)
    if isinstance(file, str) and not is_file(folder / file):
        source.add(path, _missing(folder / file))


PATHS = (".urdf", ".xml", ".yaml", ".yml")
"""File suffixes of robot models, which are URDFs or descriptions of arms."""


def is_path(model: str) -> bool:
    """Return whether a robot's `model` is a path instead of the name of a built-in arm."""
    return "/" in model or "\\" in model or model.casefold().endswith(PATHS)


def is_file(path: FilePath) -> bool:
    """Return whether a file exists; False for a name that is invalid in the file system."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
