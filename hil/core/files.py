"""Files that are whole or not there, folders with a free name, and the JSON documents in them.

A file is written as a draft beside it, which then takes its name: a crash leaves the file of before
or the new one, never half of either. What has to survive a power loss is flushed to the disk before
that; a view, which can be made again, is not. Three functions write:

===================  ======================  ========================  =====================
function             an older file           flushed to the disk       a disk that refuses
===================  ======================  ========================  =====================
`write_once`         is an error             with its folder's entry   `RecordingError`
`write_replacing`    is replaced             no                        `RecordingError`
`write_whole`        is replaced             yes                       `OSError`, as it comes
===================  ======================  ========================  =====================

JSON is strict: what it has no word for becomes its nearest (`json_value`), as a NaN would make a
document that other programs refuse.
"""

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

from hil.core.errors import DataError, RecordingError
from hil.core.text import json_text


def write_once(path: Path, content: bytes) -> None:
    """Write a file that did not exist, so that it is there after a power loss, too.

    Raises:
        RecordingError: It exists already (no file of a run is rewritten), or the disk refuses.
    """
    if path.exists():
        raise RecordingError(
            f"{path} exists already, and no file of a run is rewritten",
            hint="write a new file, or start a new run",
        )
    try:
        write_whole(path, content)
        fsync_directory(path.parent)
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def write_replacing(path: Path, content: bytes) -> None:
    """Write a view (a report, a plan on request), replacing an older one whole.

    Raises:
        RecordingError: The disk refuses, or `path` is a folder; what was there is still there then.
    """
    try:
        _write_draft(path, content, flushed=False)
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}", hint="choose another place for it"
        ) from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is either whole or not there after a crash. Raises `OSError`."""
    _write_draft(path, content, flushed=True)


def _write_draft(path: Path, content: bytes, *, flushed: bool) -> None:
    draft = path.parent / f".{path.name}.{os.getpid()}.draft"
    try:
        with draft.open("wb") as file:
            file.write(content)
            if flushed:
                file.flush()
                os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):  # where nothing can be written, nothing was
            draft.unlink()
        raise


def fsync_directory(directory: Path) -> None:
    """Make creations and renames in a directory survive a power loss."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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


def sha256_of(path: Path, length: int | None = None) -> str:
    """Hexadecimal SHA-256 of a file's content, or of its first `length` bytes."""
    with path.open("rb") as file:
        if length is not None and 0 <= length < os.fstat(file.fileno()).st_size:
            return hashlib.sha256(file.read(length)).hexdigest()
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_line(value: Any) -> str:
    """Return one line of strict JSON, see `json_value`."""
    return json_text(json_value(value), allow_nan=False)


def json_document(value: Any) -> bytes:
    """Return an indented, strict JSON document, see `json_value`."""
    return json_text(json_value(value), allow_nan=False, indent=2).encode() + b"\n"


def json_value(value: Any) -> Any:
    """Return a value as strict JSON can hold it.

    NaN and infinity become null, arrays and sets lists (sets in the order of their texts), settings
    their values; else it is `str`.
    """
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if hasattr(value, "tolist") and not isinstance(
        value, type
    ):  # numpy's arrays and numbers, without loading numpy
        return json_value(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if isinstance(value, (set, frozenset)):  # in one order: digests are taken of documents
        return sorted((json_value(item) for item in value), key=str)
    # Settings of plug-ins are pydantic models.
    return json_value(value.model_dump()) if hasattr(value, "model_dump") else str(value)


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
