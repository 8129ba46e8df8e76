"""What was done to the models of a name: a file that only grows, one JSON line per deed.

A line is committed with its newline. One that a crash has torn is none, and the next writer takes
it away. Every line carries the digest of the one before, so that a line that was changed or lost
afterwards is found.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from hil.errors import RegistryError
from hil.record.files import fsync_directory

LOG_FILE = "log.jsonl"

Event = Literal["registered", "challenger", "promoted", "kept", "rolled-back"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One deed.

    Attributes:
        event: `registered`; `challenger`: made the one to be compared; `promoted`: made champion;
            `kept`: compared, and the champion stays; `rolled-back`: an earlier champion again.
        version: Which it was done to.
        at: UTC, ISO 8601.
        by: Who did it.
        reason: In words.
        evidence: What it rests on, such as a comparison.
    """

    event: Event
    version: int
    at: str
    by: str
    reason: str = ""
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "event": self.event,
            "version": self.version,
            "at": self.at,
            "by": self.by,
            "reason": self.reason,
            "evidence": dict(self.evidence),
        }


def read_log(folder: Path) -> tuple[Entry, ...]:
    """All committed lines; a torn last one is none.

    Raises:
        RegistryError: A line is damaged, or not the one that followed the line before.
    """
    return tuple(entry for entry, _ in _lines(folder))


def append(folder: Path, entry: Entry) -> None:
    """Add a line; it is there for good when this returns. The caller holds the lock.

    Raises:
        RegistryError: The log is damaged, or cannot be written.
    """
    lines = _lines(folder)
    before = lines[-1][1] if lines else ""
    append_line(folder / LOG_FILE, entry.to_dict() | {"before": before})


def append_line(path: Path, document: Mapping[str, Any]) -> None:
    """Add a line of JSON to a file that only grows; the caller holds the lock of its folder.

    Raises:
        RegistryError: It cannot be written.
    """
    # On one line, whatever line breaks are in it.
    text = json.dumps(document, ensure_ascii=False, allow_nan=False)
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.ftruncate(descriptor, _committed(path))
            os.lseek(descriptor, 0, os.SEEK_END)
            _write(descriptor, text.encode() + b"\n")
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        fsync_directory(path.parent)
    except OSError as error:
        raise RegistryError(
            f"cannot write {path}: {error.strerror}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def read_lines(path: Path) -> list[tuple[int, bytes]]:
    """Committed lines of such a file with their numbers; a torn last one is none.

    Raises:
        RegistryError: It cannot be read.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RegistryError(
            f"cannot read {path}: {error.strerror}", hint="see whether it exists and may be read"
        ) from error
    return list(enumerate(content.split(b"\n")[:-1], start=1))


def _write(descriptor: int, content: bytes) -> None:
    while content:
        content = content[os.write(descriptor, content) :]


def _committed(path: Path) -> int:
    """Bytes up to the last line break."""
    return path.read_bytes().rfind(b"\n") + 1


def _lines(folder: Path) -> list[tuple[Entry, str]]:
    """Entries with the digests of their lines."""
    path = folder / LOG_FILE
    found: list[tuple[Entry, str]] = []
    for number, line in read_lines(path):
        before = found[-1][1] if found else ""
        found.append((_entry(path, number, line, before), hashlib.sha256(line).hexdigest()))
    return found


def _entry(path: Path, number: int, line: bytes, before: str) -> Entry:
    try:
        told = json.loads(line)
        linked = told.pop("before") == before
        entry = Entry(**told)
        if entry.event not in get_args(Event) or not isinstance(entry.version, int):
            raise ValueError(f"{entry.event!r} of {entry.version!r}")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise RegistryError(
            f"{path}:{number}: damaged: {error}", hint="restore the file from a backup"
        ) from error
    if not linked:
        raise RegistryError(
            f"{path}:{number} does not follow the line before it: the log was changed",
            hint="restore the file from a backup; `hil models check` says what agrees",
        )
    return entry
