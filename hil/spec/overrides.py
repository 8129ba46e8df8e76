"""Values from the command line laid over a file: `--set excitation.waypoints=12`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import yaml

from hil.core import KeyPath, Mark, Source, SpecError, parse, read_source, shown


def lay_over(source: Source, overrides: Mapping[str, str]) -> None:
    """Set values in a parsed file; each is YAML, its key the dotted path (`loads.0.mass_kg`).

    Mappings on the way are made as needed; lists must be long enough, or may be replaced whole.
    Problems are collected in the source, under the name `--set N`.

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
        _move_marks(source, path, name)


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
    body = yaml.dump(
        source.data, Dumper=_Plain, sort_keys=False, allow_unicode=True, default_flow_style=None
    )
    return f"# {path.name}, with\n{said}{body}"


class _Plain(yaml.SafeDumper):
    """Quotes every text that any version of YAML may take for something else."""


_WORDS = re.compile(r"[A-Za-z][A-Za-z_-]+[0-9]*")
_CONSTANTS = ("null", "true", "false", "yes", "no", "on", "off")


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    plain = _WORDS.fullmatch(value) and value.casefold() not in _CONSTANTS
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=None if plain else '"')


_Plain.add_representer(str, _text)


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
        if isinstance(data, dict) and data.get(str(step)) is None:
            data[str(step)] = {}
        if _child(data, step) is None:
            return _in_the_way(data, step)
        data = _child(data, step)
    last = path[-1]
    if isinstance(data, dict) or _child(data, last) is not None:
        data[last] = value
        return ""
    return _in_the_way(data, last)


def _in_the_way(data: Any, step: str | int) -> str:
    if isinstance(data, list):
        known = f"entries 0 to {len(data) - 1}" if data else "no entries"
        return f"there is a list with {known}, not {shown(step)}"
    return f"{shown(step)} would be below {shown(data)}"


def _move_marks(source: Source, path: KeyPath, name: str) -> None:
    source.forget(path)
    # Nothing in a value has a place of its own, nor have mappings made on the way.
    for n in range(1, len(path) + 1):
        source.keys.setdefault(path[:n], Mark(name, 0, 0))
        source.values.setdefault(path[:n], Mark(name, 0, 0))
