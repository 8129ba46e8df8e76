"""Files that are either whole or not there: write, fsync, rename, fsync the directory."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from hil.core.errors import DataError, RecordingError
from hil.core.text import json_text


def write_once(path: Path, content: bytes) -> None:
    """Write a file that did not exist, so that a crash leaves all of it or none of it.

    Raises:
        RecordingError: It exists already (no file of a run is rewritten), or the disk refuses.
    """
    if path.exists():
        raise RecordingError(
            f"{path} exists already, and no file of a run is rewritten",
            hint="write a new file, or start a new run",
        )
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        with draft.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
        fsync_directory(path.parent)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def write_replacing(path: Path, content: bytes) -> None:
    """Write a view (a report, a plan on request), replacing an older one whole.

    Raises:
        RecordingError: The disk refuses, or `path` is a folder; what was there is still there then.
    """
    draft = path.parent / f".{path.name}.{os.getpid()}.draft"
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):  # where nothing can be written, nothing was
            draft.unlink()
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}", hint="choose another place for it"
        ) from error


def fsync_directory(directory: Path) -> None:
    """Make creations and renames in a directory survive a power loss."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(path: Path, length: int | None = None) -> str:
    """Hexadecimal SHA-256 of a file's content, or of its first `length` bytes."""
    with path.open("rb") as file:
        if length is not None and 0 <= length < os.fstat(file.fileno()).st_size:
            return hashlib.sha256(file.read(length)).hexdigest()
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_line(value: Any) -> str:
    """One line of strict JSON; what JSON has no word for becomes its nearest (NaN → null)."""
    return json_text(_plain(value), allow_nan=False)


def json_document(value: Any) -> bytes:
    """An indented, strict JSON document."""
    return json_text(_plain(value), allow_nan=False, indent=2).encode() + b"\n"


_DAMAGED = "it is damaged, or no file of hil: take it from a copy that is whole"


def read_json(path: Path) -> dict[str, Any]:
    """The object a JSON file holds.

    Raises:
        DataError: The file is missing, unreadable, not JSON, or holds something else.
    """
    try:
        with open(path, "rb", opener=_at_once) as file:
            document = json.loads(file.read())
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON: {error}", hint=_DAMAGED) from error
    if not isinstance(document, dict):
        kind = type(document).__name__
        raise DataError(f"{path} holds a {kind}, not a JSON object", hint=_DAMAGED)
    return document


def _at_once(path: str, flags: int) -> int:
    """Open a file; a pipe of that name in a foreign folder reads as empty and does not block."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)


def require_known_version(where: Path, document: Mapping[str, Any], key: str, known: int) -> None:
    """Refuse what a newer hil has written.

    Raises:
        DataError: `document[key]` is no version number, or is higher than `known`.
    """
    try:
        version = int(str(document[key]))
    except (KeyError, ValueError):
        told = f"{where} does not say which format it has ({key})"
        raise DataError(told, hint=_DAMAGED) from None
    if version > known:
        raise DataError(
            f"{where} was written by a newer hil: {key} is {version}, known here up to {known}",
            hint="update hil (pip install --upgrade hil) and read it again",
        )


def _plain(value: Any) -> Any:
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(item) for item in value]
    return str(value)


def new_folder(above: Path, name: str) -> Path:
    """Create a folder of this name, or of the name and the next free number."""
    above.mkdir(parents=True, exist_ok=True)
    for n in count(1):
        path = above / (name if n == 1 else f"{name}-{n}")
        try:
            path.mkdir()
        except FileExistsError:
            continue
        return path
    raise AssertionError("there is always a next number")
