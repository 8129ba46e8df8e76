"""YAML files with positions: read, decode, parse; the rules are in `yaml_values`."""

from __future__ import annotations

from pathlib import Path as FilePath

from hil.errors import SpecError
from hil.spec.source import Problem, Source, refuse, shown
from hil.spec.yaml_nodes import MOST_BYTES
from hil.spec.yaml_values import parse_text, place_after
from hil.suggest import closest

MOST_NAMED = 8
"""Files of a folder that a hint names."""


def read_source(path: str | FilePath, kind: str = "") -> Source:
    """Read and parse one file.

    Args:
        path: The file.
        kind: Key that such files begin with, so that only such are suggested for one not there.

    Raises:
        SpecError: It is missing, unreadable, too large, not UTF-8 or not YAML.
    """
    file = FilePath(path)
    try:
        with file.open("rb") as stream:
            raw = stream.read(MOST_BYTES + 1)
    except FileNotFoundError:
        raise SpecError(f"{path}: there is no such file", hint=_neighbours(file, kind)) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SpecError(
            f"{shown(str(path), most=300)}: cannot be read: {reason}",
            hint="see whether it exists and may be read",
        ) from None
    return parse(raw, str(path))


def parse(raw: bytes | str, name: str) -> Source:
    """Parse YAML text; problems that leave the rest readable are collected in the result.

    Raises:
        SpecError: The text is too large, not UTF-8, empty, or breaks YAML's grammar.
    """
    if len(raw) > MOST_BYTES:
        raise SpecError(
            f"{name}: is larger than {MOST_BYTES // 1024} KiB, which no spec is",
            hint="keep long lists of poses in a CSV file and name it under `excitation.file`",
        )
    text = _decoded(raw, name) if isinstance(raw, bytes) else raw
    return parse_text(text, name)


def _decoded(raw: bytes, name: str) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        before = raw[: error.start].decode("utf-8")
        message = f"byte 0x{raw[error.start]:02x} is not UTF-8: save the file as UTF-8"
        raise refuse([Problem(place_after(before, name), (), message)]) from None


def _neighbours(file: FilePath, kind: str) -> str:
    if not file.parent.is_dir():
        return f"there is no folder {shown(str(file.parent), most=300)}"
    try:
        beside = [p for p in file.parent.iterdir() if p.suffix in (".yaml", ".yml")]
        names = [p.name for p in beside if not kind or _is(p, kind)]
    except (OSError, ValueError):
        names = []
    if match := closest(file.name, names):
        return f"did you mean {file.parent / match}?"
    if 0 < len(names) <= MOST_NAMED:
        return f"there is {', '.join(sorted(names))}"
    return "is the path right, seen from this folder?"


def _is(file: FilePath, kind: str) -> bool:
    """Whether a file has the key of its kind, as far as a look at its beginning tells."""
    with file.open("rb") as stream:
        lines = stream.read(20_000).split(b"\n")
    return any(line.startswith(f"{kind}:".encode()) for line in lines)
