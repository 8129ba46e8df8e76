"""YAML files with positions: read, decode, parse; the rules are in `hil.core.yaml`."""

from __future__ import annotations

from pathlib import Path as FilePath

from hil.core.errors import SpecError
from hil.core.neighbours import neighbour_of
from hil.core.source import Problem, Source, refuse, shown
from hil.core.yaml import parse_text, place_after
from hil.core.yaml_nodes import MOST_BYTES


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
        where = "" if file.is_absolute() else f" in {FilePath.cwd()}"
        told = f"{path}: there is no such file{where}"
        raise SpecError(told, hint=_neighbours(file, kind)) from None
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
    return neighbour_of(file, (".yaml", ".yml"), lambda p: not kind or _is(p, kind))


def _is(file: FilePath, kind: str) -> bool:
    """Whether a file has the key of its kind, as far as a look at its beginning tells."""
    with file.open("rb") as stream:
        lines = stream.read(20_000).split(b"\n")
    return any(line.startswith(f"{kind}:".encode()) for line in lines)
