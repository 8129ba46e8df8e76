"""The run directory: the file format of a run (described in docs/reference/files.md).

::

    runs/2026-11-21/ur5/0042-fourier-p3kg/   the name is for people; identity is start.json:uid
      start.json      who, what, when, with which versions
      spec.yaml  station.yaml  plan.json  preflight.json
      recording/00.mcap …                    one file per attempt, NN.mcap.partial while open;
                                             long ones go on in 00.001.mcap, 00.002.mcap, …
      events.jsonl    state changes, checkpoints, prompts and answers, trips; only appended to
      stop.json       outcome, reason, counts, SHA-256 per file; written last
      resume-01.json  preflight-01.json  stop-01.json    the same of the first resumption, …
      study/…  report.html                   views: may be made anew, and are replaced then
      pruned.json     recordings that were deleted; only where some were

An attempt without stop document means *interrupted*. No file but a view is ever rewritten.

Numbers are unique below a runs folder, also when processes create runs at once: a number belongs to
the process that holds `ROOT/.claim-NNNN`, and the run is prepared in a hidden folder beside its
final name, which it gets by one rename when everything that it begins with is on the disk.

A run keeps 1 MiB of the disk in reserve (`.reserve`) until its stop document is written: a full
disk must not keep a run from saying how it ended.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

from hil.core import (
    DataError,
    LockFile,
    RecordingError,
    fsync_directory,
    hold,
    holder_of,
    json_document,
    read_json,
    require_known_version,
    sha256_of,
    write_once,
)
from hil.recording.events import EventLog, foreign_lines, read_events
from hil.recording.mcap_reader import read_info
from hil.recording.mcap_writer import RECOVERED_METADATA
from hil.recording.provenance import utc_now
from hil.recording.recording_files import (
    PARTIAL_SUFFIX,
    TORN_SUFFIX,
    attempt_of,
    part_name,
    recordings_in,
)

RUN_FORMAT_VERSION = 1

Outcome = Literal["completed", "stopped", "tripped", "failed"]
RunStatus = Literal["completed", "stopped", "tripped", "failed", "interrupted"]
_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)

PRUNED = "pruned.json"
"""File that says which recordings a policy has deleted, when, and who asked for it."""

RESERVE = ".reserve"
RESERVE_BYTES = 1 << 20

_EVENTS = "events.jsonl"
_REPORT = Path("report.html")
_VERDICT = "verdict.json"
_STUDIES = "study"
_RESUME = re.compile(r"resume-(\d\d+)\.json").fullmatch

_DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT)
_CLAIM, _DRAFT = ".claim-", ".draft-"
_NUMBERED = re.compile(r"(\d{4,})-.+", re.DOTALL)


@dataclass(frozen=True)
class RunDirectory:
    """One run on disk; use `create` for a new one and `open` for one that exists.

    Attributes:
        path: The directory.
    """

    path: Path

    @classmethod
    def create(
        cls,
        runs_root: Path,
        robot: str,
        name: str,
        begin: Callable[[RunDirectory], None] | None = None,
    ) -> RunDirectory:
        """Make the directory of a new run, with the next free number under `runs_root`.

        Processes may do this at the same time: no two runs get the same number. The directory gets
        its name when `begin` has returned: a kill or a full disk before that leaves no run.

        Args:
            runs_root: The folder of all runs; made when missing.
            robot: Name of the robot in the station.
            name: Name of the run for people.
            begin: Writes the documents that the run begins with, `start.json` above all, into the
                directory, which has another name until then.

        Raises:
            RecordingError: The directory cannot be made.
            Exception: What `begin` raises; nothing is left then.
        """
        folder = (
            Path(runs_root) / datetime.now().astimezone().date().isoformat() / name_for_path(robot)
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with claimed(Path(runs_root), folder) as claim:
                (claim.draft / "recording").mkdir()
                reserve(claim.draft)
                if begin is not None:
                    begin(cls(claim.draft))
                path = folder / f"{claim.number:04d}-{name_for_path(name)}"
                claim.become(path)
        except OSError as error:
            raise RecordingError(
                f"cannot create a run directory in {folder}: {error.strerror or error}",
                hint=("free the disk, or " if error.errno in _DISK_IS_FULL else "")
                + "choose another place with --runs DIR",
            ) from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """Open an existing run.

        Raises:
            DataError: It is no run directory, cannot be read, is damaged, or was written by a newer
                hil.
        """
        run = cls(Path(path))
        try:
            there = (run.path / "start.json").is_file()
        except OSError as error:
            raise DataError(
                f"cannot read {path}: {error.strerror or error}", hint="see whether you may read it"
            ) from error
        if not there:
            raise DataError(
                f"{path} is not a run directory: it has no start.json",
                hint="hil runs lists the runs there are",
            )
        require_known_version(run.path / "start.json", run.start, "hil_run", RUN_FORMAT_VERSION)
        return run

    @property
    def number(self) -> int:
        """The running number, 0 if the directory has been renamed."""
        return number_of(self.path)

    @property
    def start(self) -> dict[str, Any]:
        """The start document. Raises `DataError` when it is missing or damaged."""
        return read_json(self.path / "start.json")

    @property
    def attempts(self) -> int:
        """Number of attempts that have begun: 1, and one more for every resumption."""
        resumed = [int(m[1]) for p in self.path.glob("resume-*.json") if (m := _RESUME(p.name))]
        return 1 + max(resumed, default=0)

    @property
    def stop(self) -> dict[str, Any] | None:
        """The stop document of the last attempt, None if it was interrupted.

        Raises:
            DataError: It is damaged.
        """
        return self.stop_of(self.attempts - 1)

    def stop_of(self, attempt: int) -> dict[str, Any] | None:
        """Return the stop document of one attempt, None if there is none. Raises `DataError`."""
        path = self.path / name_of_attempt("stop.json", attempt)
        return read_json(path) if path.exists() else None

    @property
    def status(self) -> RunStatus:
        """How the run ended; `interrupted` if it has no stop document."""
        stop = self.stop
        if stop is None:
            return "interrupted"
        for outcome in _OUTCOMES:
            if stop.get("outcome") == outcome:
                return outcome
        raise DataError(
            f"{self.path / name_of_attempt('stop.json', self.attempts - 1)} names no known outcome",
            hint="the run directory is damaged or was edited: take it from a copy",
        )

    @property
    def is_judged(self) -> bool:
        """Whether there is a verdict: the run has recorded all that it was to record."""
        return (self.path / _VERDICT).is_file()

    @property
    def is_reported(self) -> bool:
        """Whether there is a verdict, and a report that shows it."""
        return self.is_judged and (self.path / _REPORT).is_file()

    def write_verdict(self, document: Mapping[str, Any]) -> None:
        """Store the verdict and delete an older report, so that a report always shows the verdict.

        Raises:
            RecordingError: There is a verdict already, or the disk refuses.
        """
        if not self.is_judged:  # a second verdict is refused below, and the report shows the first
            (self.path / _REPORT).unlink(missing_ok=True)
        self.write_json(_VERDICT, document)

    @property
    def recordings(self) -> tuple[Path, ...]:
        """The recordings in order of attempts and their parts, unfinished ones included."""
        folder = self.path / "recording"
        return recordings_in(folder) if folder.is_dir() else ()

    @property
    def events_path(self) -> Path:
        """Path of the event log."""
        return self.path / _EVENTS

    def next_attempt(self) -> int:
        """Return the number for an attempt that begins now: no file of an older one has it."""
        recorded = [attempt_of(path) + 1 for path in self.recordings]
        begun = self.attempts if (self.path / "start.json").exists() else 0
        return max([begun, *recorded])

    def part_path(self, attempt: int, part: int = 0) -> Path:
        """Return the path of a part of an attempt's recording; part 0 is its beginning."""
        return self.path / "recording" / part_name(attempt, part)

    def event_log(self) -> EventLog:
        """Open the event log for appending."""
        return EventLog(self.events_path)

    def events(self) -> list[dict[str, Any]]:
        """Return the events logged so far."""
        return read_events(self.events_path)

    def write_text(self, name: str, text: str) -> None:
        """Store a file as given (spec.yaml, station.yaml). Raises `RecordingError` if it exists."""
        write_once(self.path / name, text.encode())

    def write_json(self, name: str, document: Any) -> None:
        """Store a JSON document (plan, preflight). Raises `RecordingError` if it exists."""
        write_once(self.path / name, json_document(document))

    def write_start(self, document: Mapping[str, Any]) -> None:
        """Store the start document; `collect_provenance` gives most of it, `uid` included."""
        self.write_json("start.json", {"hil_run": RUN_FORMAT_VERSION, **document})

    def write_resume(self, attempt: int, document: Mapping[str, Any]) -> None:
        """Store how an attempt after the first begins. Raises `RecordingError`."""
        name = name_of_attempt("resume.json", attempt)
        with contextlib.suppress(OSError):  # preflight says so if the disk is full
            reserve(self.path)
        self.write_json(name, {"hil_run": RUN_FORMAT_VERSION, "attempt": attempt, **document})

    def write_stop(
        self,
        outcome: Outcome,
        reason: str,
        document: Mapping[str, Any] | None = None,
        *,
        attempt: int = 0,
    ) -> None:
        """Store the stop document with the SHA-256 of every file; the last thing an attempt does.

        Args:
            outcome: How the run ended.
            reason: Why, in words for people.
            document: Counts, gaps, duplicates, overruns, … of the whole run.
            attempt: Which attempt ended, 0 for the first.
        """
        release(self.path)
        self.write_json(
            name_of_attempt("stop.json", attempt),
            {
                "hil_run": RUN_FORMAT_VERSION,
                "attempt": attempt,
                "outcome": outcome,
                "reason": reason,
                "stopped": utc_now(),
                **(document or {}),
                **self._checksums(),
            },
        )

    def verify(self) -> list[str]:
        """Return what differs from the checksums of the newest stop document, one line per file.

        The event log may have grown since: what it held then must be there still, and what was
        added must be events. Recordings deleted on purpose (`pruned.json`) are not missed.
        """
        ends = (self.stop_of(attempt) for attempt in reversed(range(self.attempts)))
        stop = next((end for end in ends if end is not None), {})
        recorded = stop.get("sha256", {})
        if not isinstance(recorded, dict):
            return ["stop.json holds no checksums"]
        lengths = {_EVENTS: stop.get("events_bytes")}
        pruned = self.pruned
        changed = [
            problem
            for name, digest in recorded.items()
            if (name not in pruned or (self.path / name).exists())
            and (problem := _changed(self.path / name, name, digest, lengths.get(name)))
        ]
        return changed + self.foreign_events()

    @property
    def pruned(self) -> frozenset[str]:
        """Names of recordings that were deleted on purpose. Raises `DataError` when damaged."""
        note = self.path / PRUNED
        deleted = read_json(note).get("bytes") if note.exists() else None
        return frozenset(deleted if isinstance(deleted, dict) else ())

    def foreign_events(self) -> list[str]:
        """Return a problem if the event log has lines that are no events; else nothing."""
        lines = foreign_lines(self.events_path)
        held = "1 line that is no event" if lines == 1 else f"{lines} lines that are no events"
        return [f"{_EVENTS} holds {held}: something else wrote into it"] if lines else []

    def _checksums(self) -> dict[str, Any]:
        inside = (path for path in self.path.rglob("*") if path.is_file())
        names = {path.relative_to(self.path): path for path in sorted(inside)}
        # Views (report, studies, what begins with a dot) may be made anew: they are no part of it.
        kept = {
            name: path
            for name, path in names.items()
            if name != _REPORT
            and name.parts[0] != _STUDIES
            and not any(part.startswith(".") for part in name.parts)
            and not _is_being_written(path)  # by a recorder that could not end: it changes still
        }
        try:
            sums = {name.as_posix(): sha256_of(path) for name, path in kept.items()}
            log = self.events_path
            return {"sha256": sums, "events_bytes": log.stat().st_size if log.exists() else 0}
        except OSError as error:
            raise RecordingError(
                f"cannot read {self.path} back: {error}",
                hint="hil recover RUN makes whole what is left of it",
            ) from error


def name_of_attempt(name: str, attempt: int) -> str:
    """Return `stop.json` for the first attempt, `stop-01.json`, … for those after it."""
    path = Path(name)
    return f"{path.stem}-{attempt:02d}{path.suffix}" if attempt else name


def number_of(run: Path) -> int:
    """Return the number in a run directory's name, 0 if it has been renamed."""
    match = _NUMBERED.fullmatch(run.name)
    return int(match[1]) if match else 0


def name_for_path(name: str) -> str:
    """Return a name as a folder: lower case, no separators, never empty or hidden."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "run"


def is_run(path: Path) -> bool:
    """Return whether a folder is a run, if a damaged one: by its name or its start document.

    The folders of series and fleets lie where runs lie, and are none.
    """
    # `Path.exists` raises for a folder of another user that may not be entered.
    return number_of(path) > 0 or os.path.exists(path / "start.json")


def run_folders(runs_root: Path) -> list[Path]:
    """Return every folder where a run may be, `DAY/ROBOT/RUN`; a vanished one is left out."""
    days = folders_in(Path(runs_root))
    return [run for day in days for robot in folders_in(day) for run in folders_in(robot)]


def folders_in(parent: Path) -> list[Path]:
    """Return the folders in a folder, by name, without hidden ones; none if it is unreadable."""
    try:
        return _folders_in(parent)
    except OSError:
        return []


def _folders_in(parent: Path) -> list[Path]:
    with os.scandir(parent) as entries:
        found = [entry for entry in entries if entry.is_dir()]
    os.stat(os.path.join(parent, "."))  # refused where names may be read, but nothing be opened
    return sorted(Path(entry) for entry in found if not entry.name.startswith("."))


def unreadable_folders(runs_root: Path) -> list[tuple[Path, str]]:
    """Return the folders whose runs `run_folders` leaves out, each with what the system says.

    They are the folder of runs itself, and the folders of days and robots.
    """
    unreadable: list[tuple[Path, str]] = []

    def inside(folder: Path) -> list[Path]:
        try:
            return _folders_in(folder)
        except (FileNotFoundError, NotADirectoryError):  # removed meanwhile
            return []
        except OSError as error:
            unreadable.append((folder, error.strerror or str(error)))
            return []

    for day in inside(Path(runs_root)):
        for robot in inside(day):
            inside(robot)
    return unreadable


@dataclass(frozen=True, slots=True)
class Claim:
    """A number that only this process may use, with a hidden folder in which the run is prepared.

    The number belongs to the process that holds the file `ROOT/.claim-NNNN`. Only that process
    makes, renames or removes a folder `.draft-NNNN`. A draft lies in the folder of its run, so that
    its rename stays on one file system.

    Attributes:
        number: Run number, unique under `ROOT`.
        draft: Hidden folder in which the run is prepared.
    """

    number: int
    draft: Path

    def become(self, run: Path) -> None:
        """Rename the draft to the run directory, which lies beside it. Raises `OSError`."""
        fsync_directory(self.draft)
        self.draft.rename(run)
        fsync_directory(run.parent)


@contextlib.contextmanager
def claimed(root: Path, folder: Path) -> Iterator[Claim]:
    """Hold the next free number under `root`, with a draft in `folder` (`ROOT/DAY/ROBOT`).

    Drafts of processes that died are removed before, and this draft afterwards, unless it has
    become a run.

    Raises:
        OSError: One of the folders cannot be written to.
    """
    _remove_abandoned(root)
    lock, claim = _hold_number(root, folder)
    with lock:
        try:
            yield claim
        finally:
            shutil.rmtree(claim.draft, ignore_errors=True)


def _hold_number(root: Path, folder: Path) -> tuple[LockFile, Claim]:
    number = max((number_of(run) for run in run_folders(root)), default=0)
    while True:
        number += 1
        path = root / f"{_CLAIM}{number:04d}"
        try:
            lock = hold(path)
        except PermissionError:
            if not path.exists():
                raise
            continue  # the claim of another user
        if not isinstance(lock, LockFile):
            continue
        with contextlib.ExitStack() as undo:
            undo.enter_context(lock)
            # Looked for only now: until the number was held, another process could make it a run.
            if any(number_of(run) == number for run in run_folders(root)):
                continue
            _remove_drafts(root, path)
            draft = folder / _draft_of(path)
            try:
                draft.mkdir()
            except FileExistsError:
                continue  # a draft of another user that died, and that only its owner may remove
            undo.pop_all()
            return lock, Claim(number, draft)


def _remove_abandoned(root: Path) -> None:
    """Remove the claims and the drafts of processes that died while they prepared a run."""
    for path in root.glob(f"{_CLAIM}*"):
        if holder_of(path) is not None:
            continue
        with contextlib.suppress(OSError):
            lock = hold(path)
            if isinstance(lock, LockFile):
                with lock:
                    _remove_drafts(root, path)


def _remove_drafts(root: Path, claim: Path) -> None:
    """Remove every draft of a number; the caller holds its claim."""
    for day in folders_in(root):
        for robot in folders_in(day):
            shutil.rmtree(robot / _draft_of(claim), ignore_errors=True)


def _draft_of(claim: Path) -> str:
    return _DRAFT + claim.name.removeprefix(_CLAIM)


def reserve(run: Path) -> None:
    """Take 1 MiB of the disk for a run, to be released for its stop document.

    Raises:
        OSError: There is not even that much left.
    """
    descriptor = os.open(run / RESERVE, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        # What no file system compresses or leaves out. Of a nearly full disk a part is taken first.
        if os.write(descriptor, os.urandom(RESERVE_BYTES)) < RESERVE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def release(run: Path) -> None:
    """Release what `reserve` took. Idempotent."""
    with contextlib.suppress(OSError):
        (run / RESERVE).unlink()


def _changed(path: Path, name: str, digest: object, length: object) -> str:
    if not path.is_file():
        return "" if _lives_on(path, digest) else f"{name} is missing"
    known = length if isinstance(length, int) else None
    return "" if sha256_of(path, known) == digest else f"{name} has changed since the run ended"


def _lives_on(torn: Path, digest: object) -> bool:
    """Return whether a torn recording that is gone was recovered: set aside, renamed or rebuilt."""
    if not torn.name.endswith(PARTIAL_SUFFIX):
        return False
    final = torn.with_name(torn.name.removesuffix(PARTIAL_SUFFIX))
    aside = final.with_name(final.name + TORN_SUFFIX)
    if any(path.is_file() and sha256_of(path) == digest for path in (aside, final)):
        return True
    with contextlib.suppress(DataError):
        recovered = read_info(final).metadata.get(RECOVERED_METADATA, {})
        return not aside.exists() and recovered.get("from_sha256") == digest
    return False


def _is_being_written(path: Path) -> bool:
    """Return whether a recording is being written, or given its final name, at this moment."""
    if not path.name.endswith(PARTIAL_SUFFIX):
        return False
    try:
        with path.open("rb") as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (BlockingIOError, FileNotFoundError):
        return True
    except OSError:
        pass  # a file system without locks
    return False
