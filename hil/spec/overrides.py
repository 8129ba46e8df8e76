"""Values from the command line laid over a file: `excitation.waypoints=12`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.errors import SpecError
from hil.spec.source import Mark, Path, Source, shown
from hil.spec.yaml_values import parse_text


def lay_over(source: Source, overrides: Mapping[str, str]) -> None:
    """Set values in a parsed file; each is YAML, its key the dotted path (`loads.0.mass_kg`).

    Mappings on the way are made as needed; lists must be long enough, or may be replaced whole.
    Problems are collected in the source, under the name `override KEY`.

    Raises:
        SpecError: A value is not YAML.
    """
    for dotted_key, text in overrides.items():
        name = f"override {shown(dotted_key)}"
        value = parse_text(text, name) if text.strip() else Source(name)
        source.problems += value.problems
        path = _path_in(source.data, dotted_key)
        if "" in path or not _set(source.data, path, value.data):
            message = f"{name}: there is no such place in {source.name}"
            raise SpecError(message, hint="a key is a dotted path such as loads.0.mass_kg")
        _move_marks(source, path, value)


def _path_in(data: Any, dotted_key: str) -> Path:
    path: list[str | int] = []
    for step in dotted_key.split("."):
        is_index = isinstance(data, list) and step.isascii() and step.isdigit()
        path.append(int(step[:9]) if is_index else step)
        data = _child(data, path[-1])
    return tuple(path)


def _child(data: Any, step: str | int) -> Any:
    if isinstance(data, dict):
        return data.get(step)
    if isinstance(data, list) and isinstance(step, int) and step < len(data):
        return data[step]
    return None


def _set(data: Any, path: Path, value: Any) -> bool:
    """Put `value` at `path`; False where a list or a plain value is in the way."""
    for step in path[:-1]:
        if isinstance(data, dict) and data.get(str(step)) is None:
            data[str(step)] = {}
        data = _child(data, step)
    last = path[-1]
    fits = isinstance(data, dict) or (
        isinstance(data, list) and isinstance(last, int) and last < len(data)
    )
    if fits:
        data[last] = value
    return fits


def _move_marks(source: Source, path: Path, value: Source) -> None:
    source.forget(path)
    start = Mark(value.name, 1, 1)
    # Mappings made on the way have no place of their own: they get the override's.
    for n in range(1, len(path) + 1):
        source.keys.setdefault(path[:n], start)
        source.values.setdefault(path[:n], start)
    source.keys |= {(*path, *below): mark for below, mark in value.keys.items()}
    source.values |= {(*path, *below): mark for below, mark in value.values.items()}
