"""Look up what an experiment or a station names outside itself.

These are estimators, studies, interlocks, drivers, arms and files. The checks read the parsed data
and not the validated model, so that their findings come in the same report as everything else that
is wrong with the file.
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
        line = _first_line(error)
        culprit = next((key for key in given if re.match(rf"{re.escape(key)}\b", line)), None)
        source.add((*path, culprit) if culprit else path, line)


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
