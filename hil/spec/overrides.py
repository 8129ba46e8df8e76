"""Overrides from the command line for a parsed file: `--set excitation.waypoints=12`."""

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
    """Apply overrides to a parsed file; each is YAML text by dotted path (`loads.0.mass_kg`).

    Mappings that are missing on the path of an override are created, also in place of null. An
    override may replace a list, but cannot extend it. Problems with overrides are added to the
    source, under the name `--set N`.

    Raises:
        SpecError: A value is not YAML, a path does not exist, or an override would undo an earlier
            override.
    """
    _require_apart(list(overrides))
    for number, (dotted_key, text) in enumerate(overrides.items(), 1):
        name = f"--set {number}"
        option = f"{name}: {shown(dotted_key)}"
        value = parse(text, option) if text.strip() else Source(option)
        source.problems += value.problems
        path = _path_in(source.data, dotted_key)
        if (
            why := "a part of the path is empty"
            if "" in path
            else _set(source.data, path, value.data)
        ):
            message = f"{option}: this path does not exist in {source.name}: {why}"
            raise SpecError(message, hint="write a dotted path, such as loads.0.mass_kg")
        source.replaced(path, name)


def _require_apart(dotted_keys: list[str]) -> None:
    """Raise if two paths are equal or one contains the other, because the last would win."""
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
                hint="pass each path once, and no path below another: combine both in one value",
            )


def _comparable(dotted_key: str) -> tuple[str, ...]:
    """Return the steps of a path, with indices in a uniform notation."""
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
    """Set `value` at `path`; return the reason if a list or a plain value there prevents it."""
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
    """Return whether `data` is a mapping, or a list with the entry `step` (possibly null)."""
    if isinstance(data, list):
        return isinstance(step, int) and step < len(data)
    return isinstance(data, dict)


def _in_the_way(data: Any, step: str | int) -> str:
    if isinstance(data, list):
        known = f"entries 0 to {len(data) - 1}" if data else "no entries"
        return f"the list has {known}, not {shown(step)}"
    return f"the value {shown(data)} cannot contain {shown(step)}"


def resolved_text(path: FilePath, overrides: Mapping[str, str]) -> str:
    """Return the text of a file with its overrides, as YAML without the original comments.

    Comments at the beginning of the text list the overrides.

    Raises:
        SpecError: The file cannot be read, or an override cannot be applied.
    """
    source = read_source(path)
    lay_over(source, overrides)
    lines = "".join(
        f"#   --set {shown(key, 300)}={shown(text, 300)}\n" for key, text in overrides.items()
    )
    return f"# {path.name}, with\n{lines}{yaml_text(source.data)}"
