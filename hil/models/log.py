"""Log of a model name in the registry: an append-only file with one JSON line per event.

A log line is committed by its newline character. A torn last line is not committed, and the next
writer of the log removes it. Every log line contains the digest of the previous line. A changed or
lost line is therefore detected by the line after it. The last line of the log has no line after it.
For the last line, `head.json` beside the log contains the number of lines and the digest.
`head.json` is written after the log line that it describes. If a writer is killed between the two
writes, `head.json` is one line behind the log, and the next writer updates it. Any other difference
between log and `head.json` counts as damage, which only `repair` may overwrite.

Only one writer at a time owns the lock of a model name (`writing`). Readers of the log need no
lock, because a committed line never changes.

The role of each version follows from the events of the log (`Aliases.after`):

| role                  | event of this version | next role  | and the others                  |
|-----------------------|-----------------------|------------|---------------------------------|
| (new)                 | registered            | none       |                                 |
| none, champion before | challenger            | challenger | the challenger until now: none  |
| any but champion      | promoted              | champion   | the champion until now: before; |
|                       |                       |            | the challenger: none            |
| challenger            | kept                  | none       |                                 |
| champion before       | rolled-back           | champion   | champions after that one: none  |

`repaired` restores the roles that are listed in its evidence. Events of other kinds change no role.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from hil.core import (
    RegistryError,
    fsync_directory,
    json_document,
    json_line,
    shell_word,
    write_whole,
)
from hil.models.version import folder_of, numbers_in, read_version
from hil.recording import operator, utc_now

LOG_FILE = "log.jsonl"
HEAD_FILE = "head.json"
ALIASES_FILE = "aliases.json"

HEAD_FORMAT = 1

Event = Literal[
    "registered", "challenger", "promoted", "kept", "rolled-back", "head-adopted", "repaired"
]

CHAMPION_EVENTS = ("promoted", "rolled-back", "repaired")
"""Kinds of event after which the version of the event is the champion."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Event in the log of a model name.

    Attributes:
        event: Kind of the event, one of the following. `registered`: the version was registered.
            `challenger`: the version
            became the challenger. `promoted`: the version became the champion. `kept`: the version
                was compared, and the champion stayed. `rolled-back`: an earlier champion became
                champion again. `head-adopted`: `head.json` was created for a log that had none.
                `repaired`: the log was rebuilt; `evidence` contains champion and challenger.
        version: Number of the version; 0 for an event that concerns the log as a whole.
        at: Time of the event, UTC, ISO 8601.
        by: User who caused the event.
        reason: Reason for the event in words.
        evidence: Evidence of the decision, such as a comparison.
    """

    event: Event
    version: int
    at: str
    by: str
    reason: str = ""
    evidence: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Label of the event's version, such as `v3`; empty for an event of the log as a whole."""
        return f"v{self.version}" if self.version else ""

    def to_dict(self) -> dict[str, Any]:
        """Return the event as a JSON object."""
        return {
            "event": self.event,
            "version": self.version,
            "at": self.at,
            "by": self.by,
            "reason": self.reason,
            "evidence": dict(self.evidence),
        }


@dataclass(frozen=True, slots=True)
class Aliases:
    """Version number of each role; 0 if no version has the role.

    Attributes:
        champion: Number of the version in use.
        challenger: Number of the version to be compared with the champion.
        before: Numbers of former champions, newest last.
    """

    champion: int = 0
    challenger: int = 0
    before: tuple[int, ...] = ()

    @staticmethod
    def after(log: Iterable[Entry]) -> Aliases:
        """Return the roles after all events of a log."""
        now = Aliases()
        for entry in log:
            now = now._with(entry)
        return now

    def _with(self, entry: Entry) -> Aliases:
        if entry.event == "challenger":
            return Aliases(self.champion, entry.version, self.before)
        if entry.event == "promoted":
            left = (self.champion,) if self.champion else ()
            return Aliases(entry.version, 0, self.before + left)
        if entry.event == "rolled-back":
            # Later champions are removed: a second rollback must not return to them.
            before = list(self.before)
            while before and before.pop() != entry.version:
                pass
            return Aliases(entry.version, self.challenger, tuple(before))
        if entry.event == "kept" and self.challenger == entry.version:
            return Aliases(self.champion, 0, self.before)
        if entry.event == "repaired":
            return Aliases.from_dict(entry.evidence["aliases"])
        return self

    def to_dict(self) -> dict[str, Any]:
        """Return the roles as a JSON object."""
        return {
            "champion": self.champion or None,
            "challenger": self.challenger or None,
            "before": list(self.before),
        }

    @staticmethod
    def from_dict(document: Mapping[str, Any]) -> Aliases:
        """Return the roles described by a JSON object that `to_dict` wrote.

        Raises:
            ValueError, TypeError, KeyError: The object lacks a role or contains an invalid version
                number.
        """
        return Aliases(
            int(document["champion"] or 0),
            int(document["challenger"] or 0),
            tuple(int(one) for one in document["before"]),
        )

    def of_versions(self, numbers: Iterable[int]) -> Aliases:
        """Return the roles of the versions in `numbers`, without those of other versions."""
        there = frozenset(numbers)
        return Aliases(
            self.champion if self.champion in there else 0,
            self.challenger if self.challenger in there else 0,
            tuple(one for one in self.before if one in there),
        )


def read_log(folder: Path) -> tuple[Entry, ...]:
    """Return all committed lines of a log, without a torn last line.

    Raises:
        RegistryError: The log is damaged or cannot be read.
    """
    state = inspect(folder)
    if state.problem:
        raise damaged(folder, state.problem)
    return state.entries


def registered_in(log: Iterable[Entry]) -> frozenset[int]:
    """Return the registered versions in a log, except those that a repair recorded as lost."""
    numbers: set[int] = set()
    for entry in log:
        if entry.event == "registered":
            numbers.add(entry.version)
        elif entry.event == "repaired":
            numbers.difference_update(_lost_at(entry))
    return frozenset(numbers)


def last_number(log: Iterable[Entry]) -> int:
    """Return the highest version number in a log; 0 if there is none."""
    return max((max(entry.version, *_lost_at(entry), 0) for entry in log), default=0)


def _lost_at(entry: Entry) -> tuple[int, ...]:
    """Return the versions whose folders were missing at a repair of the log."""
    return tuple(int(one) for one in entry.evidence.get("lost", ()))


def damaged(folder: Path, problem: str) -> RegistryError:
    """Return the error for a damaged log."""
    command = f"hil models repair {shell_word(folder.name)} --registry {shell_word(folder.parent)}"
    return RegistryError(
        problem,
        hint="restore the file or folder from a backup, or rebuild the log from the versions: "
        + command,
    )


@dataclass(frozen=True, slots=True)
class Inspection:
    """State of a log, determined from the log, its head, `aliases.json` and the version folders.

    Attributes:
        entries: Confirmed events of the log, from the first line on.
        raw: Bytes of the confirmed log lines.
        problem: Description of the damage to the log; empty if the log is intact.
        last_sha256: Digest of the last confirmed line.
        has_head: Flag; true if a valid `head.json` exists.
        behind: Flag; true if `head.json` lacks the last line of the log.
        aliases: Champion and challenger, read from the best remaining source.
        source: Name of the file that is the source of `aliases`.
        lost: Numbers of versions that are in the log or have a role, but whose folders are missing.
    """

    entries: tuple[Entry, ...]
    raw: bytes
    problem: str
    last_sha256: str
    has_head: bool
    behind: bool
    aliases: Aliases
    source: str
    lost: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Head:
    """Content of `head.json`: number of log lines, digest of the last one, and roles after it."""

    lines: int
    sha256: str
    aliases: Aliases


@dataclass(frozen=True, slots=True)
class _Line:
    """Committed line of a log.

    Attributes:
        numbered: Flag; true if the line contains its number, false for lines older than the head.
    """

    entry: Entry
    raw: bytes
    sha256: str
    numbered: bool


def inspect(folder: Path) -> Inspection:
    """Compare a log with its head or, without a head, with `aliases.json` and the version folders.

    No lock is needed for the comparison: head and version folders are read before the log, which is
    append-only. The head is read again after the log, because a writer may have appended a line
    meanwhile.

    Raises:
        RegistryError: The log cannot be read.
    """
    numbers, view, head = numbers_in(folder), _read_view(folder), _read_head(folder)
    lines, problem = _chain(folder)
    if head == "" and (folder / HEAD_FILE).exists():
        return inspect(folder)  # a writer has created the head meanwhile
    # A folder is created before its line: read the folders after the lines.
    there = numbers_in(folder)
    entries = tuple(line.entry for line in lines)
    confirmed, has_head, behind = len(lines), isinstance(head, _Head), False
    aliases, source = Aliases.after(entries), LOG_FILE
    if isinstance(head, _Head):
        # A changed last line and the lines after it are not confirmed.
        if len(lines) >= head.lines and lines[head.lines - 1].sha256 != head.sha256:
            confirmed = head.lines - 1
            where = f"{folder / LOG_FILE}:{head.lines}"
            problem = problem or f"{where} was changed: its digest is not the recorded one"
        elif len(lines) >= head.lines and head.aliases != Aliases.after(entries[: head.lines]):
            problem = problem or (
                f"{folder / HEAD_FILE} was changed: its roles differ from those after line "
                f"{head.lines} of {LOG_FILE}"
            )
        if confirmed < head.lines:
            aliases, source = head.aliases, HEAD_FILE
            problem = problem or _lost_lines(folder, len(lines), head)
        elif not problem and confirmed > 1 + _lines_of(_read_head(folder), head.lines):
            problem = (
                f"{folder / LOG_FILE} has {confirmed} lines but {HEAD_FILE} records "
                f"{head.lines}: one of the two files is outdated"
            )
        behind = confirmed > head.lines
    else:
        behind = bool(lines) and lines[-1].numbered
        problem = problem or head or _without_head(folder, lines, numbers, view)
        if problem and view is not None and view not in _states(entries):
            aliases, source = view, ALIASES_FILE
    named = {aliases.champion, aliases.challenger, *aliases.before} - {0}
    lost = tuple(sorted((registered_in(entries[:confirmed]) | named) - set(there)))
    if lost:
        problem = problem or _lost_versions(folder, lost, aliases)
    return Inspection(
        entries[:confirmed],
        b"".join(line.raw + b"\n" for line in lines[:confirmed]),
        problem,
        lines[confirmed - 1].sha256 if confirmed else "",
        has_head,
        behind,
        aliases.of_versions(there) if problem else aliases,
        source,
        lost,
    )


def _read_head(folder: Path) -> _Head | str:
    """Return the head, an empty text if `head.json` is missing, or the problem of the head."""
    path = folder / HEAD_FILE
    try:
        document = json.loads(path.read_bytes())
        if document["hil_head"] != HEAD_FORMAT:
            raise ValueError(f"format {document['hil_head']!r}")
        lines, sha256 = document["lines"], document["sha256"]
        if not isinstance(lines, int) or lines < 1 or not isinstance(sha256, str):
            raise ValueError(f"{lines!r} lines, digest {sha256!r}")
        return _Head(lines, sha256, Aliases.from_dict(document))
    except FileNotFoundError:
        return ""
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        return f"{path} cannot be read: {error}"


def _lines_of(head: _Head | str, otherwise: int) -> int:
    return head.lines if isinstance(head, _Head) else otherwise


def _read_view(folder: Path) -> Aliases | None:
    try:
        return Aliases.from_dict(json.loads((folder / ALIASES_FILE).read_bytes()))
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None  # the view is optional


def _chain(folder: Path) -> tuple[list[_Line], str]:
    """Return the committed lines up to the first broken digest link, and the problem there."""
    path = folder / LOG_FILE
    lines: list[_Line] = []
    for number, raw in read_lines(path):
        try:
            document = json.loads(raw)
            linked = document.pop("before") == (lines[-1].sha256 if lines else "")
            numbered = document.pop("line", None)
            entry = Entry(**document)
            if entry.event not in get_args(Event) or not isinstance(entry.version, int):
                raise ValueError(f"{entry.event!r} of {entry.version!r}")
            Aliases.after([entry])  # raises if the evidence of a repair is garbled
            last_number([entry])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            return lines, f"{path}:{number}: damaged: {error}"
        if not linked or numbered not in (None, number):
            # The line before may have been changed: this line has the digest of its original.
            return lines[:-1], (
                f"{path}:{number} does not follow the line before it: the log was changed"
            )
        sha256 = hashlib.sha256(raw).hexdigest()
        lines.append(_Line(entry, raw, sha256, numbered is not None))
    return lines, ""


def _states(entries: Sequence[Entry]) -> list[Aliases]:
    """Return the roles of versions before the first log line and after each line."""
    return [Aliases.after(entries[:k]) for k in range(len(entries) + 1)]


def _lost_lines(folder: Path, there: int, head: _Head) -> str:
    """Return a text about the lines that the head records but the log lacks."""
    path = folder / LOG_FILE
    champion = f"v{head.aliases.champion}" if head.aliases.champion else "none"
    after = f"; the champion after line {head.lines} was {champion}"
    if not path.exists():
        return f"{path} with its {head.lines} lines is missing{after}"
    lost = f"line {head.lines}" if there == head.lines - 1 else f"lines {there + 1} to {head.lines}"
    verb = "is" if there == head.lines - 1 else "are"
    return (
        f"{path}: {lost} {verb} missing or truncated "
        f"({HEAD_FILE} records {head.lines} {'line' if head.lines == 1 else 'lines'}){after}"
    )


def _without_head(
    folder: Path, lines: Sequence[_Line], numbers: Sequence[int], view: Aliases | None
) -> str:
    """Return the problem of a log without a head; empty for a new log or an older log format.

    A log of an older format is compared with `aliases.json` and the version folders. After a crash,
    at most one version is missing from a log of an older format, and `aliases.json` may be older
    than the log.
    """
    path, entries = folder / LOG_FILE, tuple(line.entry for line in lines)
    if any(line.numbered for line in lines[:-1]):
        return f"{folder / HEAD_FILE} is missing: nothing confirms the last line of {path}"
    known = registered_in(entries)
    unknown = [f"v{number}" for number in numbers if number not in known]
    if len(unknown) > 1:
        return f"{path}: the lines that registered {', '.join(unknown)} are missing"
    if view is not None and view not in _states(entries):
        roles = f"champion v{view.champion}" if view.champion else "no champion"
        return f"{path}: lines are missing: no line leads to {roles}, as in {ALIASES_FILE}"
    return ""


def _lost_versions(folder: Path, lost: Sequence[int], aliases: Aliases) -> str:
    """Return a text about the missing version folders and their roles."""
    roles = {aliases.challenger: " (challenger)", aliases.champion: " (champion)"}
    names = ", ".join(folder_of(folder, one).name + roles.get(one, "") for one in lost)
    return f"{folder}: version folders that {LOG_FILE} names are missing: {names}"


def append(folder: Path, entry: Entry) -> None:
    """Append a line durably to a log; the caller must own the lock of the model name.

    Raises:
        RegistryError: The log is damaged or cannot be written.
    """
    _append(folder, settle(folder), entry)


def settle(folder: Path) -> Inspection:
    """Update `head.json`, or create it for a log of an older format; the caller must own the lock.

    Returns:
        State of the log after the update.

    Raises:
        RegistryError: The log is damaged or cannot be written.
    """
    state = inspect(folder)
    if state.problem:
        raise damaged(folder, state.problem)
    if state.entries and not state.has_head and not state.behind:
        reason = f"from here on, {HEAD_FILE} records the number of lines and the last digest"
        _append(folder, state, Entry("head-adopted", 0, utc_now(), operator(), reason))
        return inspect(folder)
    if state.behind:
        _write_head(folder, state.entries, state.last_sha256)
    return state


def _append(folder: Path, before: Inspection, entry: Entry) -> None:
    line = _line(entry, before.last_sha256, len(before.entries) + 1)
    _append_bytes(folder / LOG_FILE, line)
    _write_head(folder, (*before.entries, entry), hashlib.sha256(line).hexdigest())


def _line(entry: Entry, before: str, number: int) -> bytes:
    return json_line(entry.to_dict() | {"before": before, "line": number}).encode()


def _write_head(folder: Path, entries: Sequence[Entry], sha256: str) -> None:
    aliases = Aliases.after(entries).to_dict()
    document = {"hil_head": HEAD_FORMAT, "lines": len(entries), "sha256": sha256, **aliases}
    _replace(folder / HEAD_FILE, json_document(document))


def _replace(path: Path, content: bytes) -> None:
    """Replace the content of a file atomically and durably."""
    try:
        write_whole(path, content)
        fsync_directory(path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error


@dataclass(frozen=True, slots=True)
class Repair:
    """Summary of a repair.

    Attributes:
        problem: Description of the damage that was repaired.
        lines: Number of confirmed log lines, which the log retains.
        lines_set_aside: Number of unconfirmed log lines, which only the backup in `aside` contains.
        registered: Numbers of versions that were added to the log because their folders exist.
        lost: Numbers of versions with missing folders, which no longer have a role.
        aliases: Champion and challenger after the repair.
        source: Name of the file from which `aliases` was read.
        aside: Folder with a backup of log, head and view before the repair.
    """

    problem: str
    lines: int
    lines_set_aside: int
    registered: tuple[int, ...]
    lost: tuple[int, ...]
    aliases: Aliases
    source: str
    aside: Path

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as a JSON object."""
        return {
            "problem": self.problem,
            "lines": self.lines,
            "lines_set_aside": self.lines_set_aside,
            "registered": list(self.registered),
            "lost": list(self.lost),
            "aliases": self.aliases.to_dict(),
            "source": self.source,
            "aside": str(self.aside),
        }


def repair(folder: Path) -> Repair | None:
    """Rebuild a damaged log from its intact lines and the version folders.

    Champion and challenger are read from `head.json` if the log has fewer lines than the head
    records, and from `aliases.json` if there is no head. Copies of log, head and view are stored in
    a separate folder before the repair. If the process is killed during the repair, the log is
    still damaged, and `repair` can be repeated. The caller of `repair` must own the lock of the
    model name.

    Returns:
        Summary of the repair; None if the log was intact.

    Raises:
        RegistryError: The folder of a version is damaged, or the folder of the name cannot be
            written.
    """
    state = inspect(folder)
    if not state.problem:
        return None
    known = registered_in(state.entries)
    missing = [read_version(folder, one) for one in numbers_in(folder) if one not in known]
    aside = _set_aside(folder)
    outcome = Repair(
        state.problem,
        len(state.entries),
        _lines_in(folder / LOG_FILE) - len(state.entries),
        tuple(one.number for one in missing),
        state.lost,
        state.aliases,
        state.source,
        aside,
    )
    events = [Entry("registered", one.number, one.registered, one.by) for one in missing]
    events.append(
        Entry(
            "repaired", state.aliases.champion, utc_now(), operator(), state.problem,
            outcome.to_dict() | {"aside": aside.name},
        )
    )  # fmt: skip
    raw, sha256 = state.raw, state.last_sha256
    for number, entry in enumerate(events, start=len(state.entries) + 1):
        line = _line(entry, sha256, number)
        raw, sha256 = raw + line + b"\n", hashlib.sha256(line).hexdigest()
    _replace(folder / LOG_FILE, raw)
    _write_head(folder, (*state.entries, *events), sha256)
    return outcome


def _lines_in(path: Path) -> int:
    """Return the number of lines in the log, including a torn last line."""
    content = path.read_bytes() if path.exists() else b""
    return content.count(b"\n") + bool(content.rpartition(b"\n")[2])


def _set_aside(folder: Path) -> Path:
    """Copy the log, its head and its view into a new folder, which is created atomically."""
    stamp = utc_now()[:19].replace(":", "").replace("-", "")
    names = (f"damaged-{stamp}" + (f"-{k}" if k else "") for k in range(1000))
    aside = next(path for name in names if not (path := folder / name).exists())
    draft = folder / f".{aside.name}.{os.getpid()}"
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        for name in (LOG_FILE, HEAD_FILE, ALIASES_FILE):
            if (folder / name).exists():
                write_whole(draft / name, (folder / name).read_bytes())
        fsync_directory(draft)
        draft.rename(aside)
        fsync_directory(folder)
    except OSError as error:
        raise _cannot_write(aside, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return aside


def write_view(folder: Path, aliases: Aliases) -> None:
    """Write `aliases.json`, a summary of the log for human readers."""
    _replace(folder / ALIASES_FILE, json_document(aliases.to_dict()))


def append_line(path: Path, document: Mapping[str, Any]) -> None:
    """Append a JSON line to an append-only file; the caller must own the lock of the file's folder.

    Raises:
        RegistryError: The file cannot be written.
    """
    _append_bytes(path, json_line(document).encode())


def read_lines(path: Path) -> list[tuple[int, bytes]]:
    """Return the committed lines of an append-only file, each with its line number.

    A torn last line of the file is not included.

    Raises:
        RegistryError: The file cannot be read.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RegistryError(
            f"cannot read {path}: {error.strerror}", hint="check that it exists and is readable"
        ) from error
    return list(enumerate(content.split(b"\n")[:-1], start=1))


def _append_bytes(path: Path, line: bytes) -> None:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.ftruncate(descriptor, _committed(path))
            os.lseek(descriptor, 0, os.SEEK_END)
            _write(descriptor, line + b"\n")
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        fsync_directory(path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error


def _cannot_write(path: Path, error: OSError) -> RegistryError:
    return RegistryError(
        f"cannot write {path}: {error.strerror or error}",
        hint="check that the folder is writable and that the disk has space",
    )


def _write(descriptor: int, content: bytes) -> None:
    while content:
        content = content[os.write(descriptor, content) :]


def _committed(path: Path) -> int:
    """Return the number of bytes up to and including the last line break of the file."""
    return path.read_bytes().rfind(b"\n") + 1


LOCK_FILE = ".lock"
PATIENCE_S = 30.0
"""Maximum time to wait for a different writer [s]: a registration copies files, a promotion writes
one line.
"""

_POLL_S = 0.01


@contextmanager
def writing(folder: Path, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Hold the lock of a model name inside a `with` block.

    The kernel releases the lock of a model name if the process dies.

    Raises:
        RegistryError: The lock file cannot be created, or a different process owns the lock for
            longer than `patience_s` seconds.
    """
    from filelock import FileLock, Timeout

    try:
        folder.mkdir(parents=True, exist_ok=True)
        # No soft lock: its file would remain after a crash and block the registry.
        lock = FileLock(folder / LOCK_FILE, timeout=patience_s, fallback_to_soft=False)
        lock.acquire(poll_interval=_POLL_S)
    except Timeout as error:
        raise RegistryError(
            f"another process has been writing in {folder} for {patience_s:g} s",
            hint="try again when that process has finished",
        ) from error
    except OSError as error:
        raise RegistryError(
            f"cannot write in {folder}: {error.strerror or error}",
            hint="name a writable registry with --registry, on a file system with file locks",
        ) from error
    try:
        yield
    finally:
        lock.release()
