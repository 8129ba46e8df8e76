"""Files that are either complete or absent, folders with unique names, and JSON documents.

A file is first written as a draft in the same folder, and then the draft is renamed. After a crash,
the folder contains either the previous or the new file, never a partial file. Files that have to
survive a power loss are flushed to the disk before they are renamed; a view, which can be computed
again, is not flushed. Three functions write files with different guarantees:

===================  ======================  ========================  =====================
function             existing file           flushed to the disk       error if not writable
===================  ======================  ========================  =====================
`write_once`         error                   yes, with its folder      `RecordingError`
`write_replacing`    replaced                no                        `RecordingError`
`write_whole`        replaced                yes                       `OSError`
===================  ======================  ========================  =====================

JSON documents are strict: values that JSON cannot represent are replaced by similar values
(`json_value`), because other programs refuse documents with NaN.
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
    """Write a new file that survives a power loss.

    Raises:
        RecordingError: The file exists already (files of a run are never rewritten), or cannot be
            written.
    """
    if path.exists():
        raise RecordingError(
            f"{path} exists already, and files of a run are never overwritten",
            hint="write a new file, or start a new run",
        )
    try:
        write_whole(path, content)
        fsync_directory(path.parent)
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}",
            hint="check that the folder is writable and the disk has free space",
        ) from error


def write_replacing(path: Path, content: bytes) -> None:
    """Write a view (a report, a requested plan) and atomically replace an older file.

    Raises:
        RecordingError: The file cannot be written, or `path` is a folder; an older file remains
            unchanged.
    """
    try:
        _write_draft(path, content, flushed=False)
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}", hint="choose a different path"
        ) from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is either complete or absent after a crash.

    Raises:
        OSError: The file cannot be written.
    """
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
        with contextlib.suppress(OSError):  # the draft possibly does not exist
            draft.unlink()
        raise


def fsync_directory(directory: Path) -> None:
    """Flush a directory, so that created and renamed files survive a power loss."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def new_folder(above: Path, name: str) -> Path:
    """Create a folder with the requested name, or with this name and the next free number."""
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
    """Return the hexadecimal SHA-256 of a file, or of the first `length` bytes of the file."""
    with path.open("rb") as file:
        if length is not None and 0 <= length < os.fstat(file.fileno()).st_size:
            return hashlib.sha256(file.read(length)).hexdigest()
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_line(value: Any) -> str:
    """Return a document as one line of strict JSON, see `json_value`."""
    return json_text(json_value(value), allow_nan=False)


def json_document(value: Any) -> bytes:
    """Return a document as indented, strict JSON, see `json_value`."""
    return json_text(json_value(value), allow_nan=False, indent=2).encode() + b"\n"


def json_value(value: Any) -> Any:
    """Return a value that strict JSON can represent.

    NaN and infinity are replaced by null. Arrays and sets are replaced by lists (sets in the order
    of their texts). Settings of plug-ins (pydantic models) are replaced by dicts of their values.
    Any other value is replaced by its text (`str`).
    """
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if hasattr(value, "tolist") and not isinstance(
        value, type
    ):  # numpy arrays and numbers, without importing numpy
        return json_value(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if isinstance(value, (set, frozenset)):  # sorted, so that digests of documents are stable
        return sorted((json_value(item) for item in value), key=str)
    # Settings of plug-ins are pydantic models.
    return json_value(value.model_dump()) if hasattr(value, "model_dump") else str(value)


_DAMAGED = "the file is damaged, or not a file of hil: restore it from an intact copy"


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that a JSON file contains.

    Raises:
        DataError: The file is missing, unreadable, not JSON, or contains a value that is not a JSON
            object.
    """
    try:
        with open(path, "rb", opener=_at_once) as file:
            document = json.loads(file.read())
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="check that the file exists and is readable",
        ) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON: {error}", hint=_DAMAGED) from error
    if not isinstance(document, dict):
        kind = type(document).__name__
        raise DataError(f"{path} contains a {kind}, not a JSON object", hint=_DAMAGED)
    return document


def _at_once(path: str, flags: int) -> int:
    """Open a file without blocking; a pipe with the name of the file reads as empty."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)


def require_known_version(where: Path, document: Mapping[str, Any], key: str, known: int) -> None:
    """Raise if a document was written by a newer version of hil.

    Raises:
        DataError: The value `document[key]` is not a version number, or is higher than `known`.
    """
    try:
        version = int(str(document[key]))
    except (KeyError, ValueError):
        message = f"{where} does not contain its format version ({key})"
        raise DataError(message, hint=_DAMAGED) from None
    if version > known:
        raise DataError(
            f"{where} was written by a newer hil: {key} is {version}, the highest known version "
            f"is {known}",
            hint="update hil (pip install --upgrade hil) and read the file again",
        )
