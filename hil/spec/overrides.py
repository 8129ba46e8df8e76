"""Values from the command line, laid over a parsed file: `--set excitation.waypoints=12`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

from hil.core import (
    KeyPath,
    Source,
    SpecError,
    parse,
    read_source,
    shown,
    yaml_text,
)


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
        option = f"{name}: {shown(dotted_key)}"
        value = parse(text, option) if text.strip() else Source(option)
        source.problems += value.problems
        path = _path_in(source.data, dotted_key)
        if why := "a step of it is empty" if "" in path else _set(source.data, path, value.data):
            message = f"{option}: there is no such place in {source.name}: {why}"
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
    lines = "".join(
        f"#   --set {shown(key, 300)}={shown(text, 300)}\n" for key, text in overrides.items()
    )
    return f"# {path.name}, with\n{lines}{yaml_text(source.data)}"
