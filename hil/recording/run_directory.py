"""Run directory: the file format of a run (described in docs/reference/files.md).

::

    runs/2026-11-21/ur5/0042-fourier-p3kg/   name for operators; the identity is start.json:uid
      start.json      author, purpose, time, versions
      spec.yaml  station.yaml  plan.json  preflight.json
      recording/00.mcap …                    one file per attempt, NN.mcap.partial while open;
                                             long ones continue in 00.001.mcap, 00.002.mcap, …
      events.jsonl    state changes, checkpoints, prompts and answers, trips; append-only
      stop.json       outcome, reason, counts, SHA-256 per file; written last
      resume-01.json  preflight-01.json  stop-01.json    documents of the first resumption, …
      study/…  report.html                   views: replaced when they are created again
      pruned.json     list of deleted recordings; only if some were deleted

An attempt whose stop document is missing was *interrupted*. Only the view files, such as reports,
are ever rewritten; every other file is written a single time.

Run numbers are unique within a runs folder, even if several processes create runs at the same time:
a number belongs to the process that holds the lock `ROOT/.claim-NNNN`. A new run is prepared in a
hidden folder next to its final path. A single rename moves the hidden folder to the final path as
soon as all initial documents are on the disk.

A run reserves 1 MiB of disk space (`.reserve`) until its stop document is written, so that the stop
document can be written even if the disk is full.
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
"""Name of the file that lists deleted recordings, with the time of deletion and the operator who
requested the deletion."""

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
    """Directory of one run; use `create` for a new run and `open` for an existing run.

    Attributes:
        path: Path of the run directory.
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
        """Create the directory of a new run, with the next free number under `runs_root`.

        Several processes can create runs at the same time without getting the same run number. The
        run directory gets its final name after `begin` has returned: if the process is killed or
        the disk becomes full earlier, no run remains.

        Args:
            runs_root: Folder of all runs; a missing folder is created.
            robot: Name of the robot in the station.
            name: Name of the run, chosen by the operator.
            begin: Callback that writes the initial documents of the run, including `start.json`,
                into the directory. The run directory has a temporary name while `begin` is called.

        Raises:
            RecordingError: The run directory cannot be created.
            Exception: `begin` raised this exception; the temporary directory was removed.
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
                + "choose a different folder with --runs DIR",
            ) from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """Open the directory of an existing run.

        Raises:
            DataError: The path is not a run directory, cannot be read, is damaged, or was written
                by a newer version of hil.
        """
        run = cls(Path(path))
        try:
            there = (run.path / "start.json").is_file()
        except OSError as error:
            raise DataError(
                f"cannot read {path}: {error.strerror or error}",
                hint="check the permissions of the file",
            ) from error
        if not there:
            raise DataError(
                f"{path} is not a run directory: it has no start.json",
                hint="list the runs with: hil runs",
            )
        require_known_version(run.path / "start.json", run.start, "hil_run", RUN_FORMAT_VERSION)
        return run

    @property
    def number(self) -> int:
        """Number of the run, or 0 if the directory has been renamed."""
        return number_of(self.path)

    @property
    def start(self) -> dict[str, Any]:
        """Content of the start document `start.json`.

        Raises `DataError` if the start document is missing or damaged.
        """
        return read_json(self.path / "start.json")

    @property
    def attempts(self) -> int:
        """Number of attempts that have begun, which is 1 plus the number of resumptions."""
        resumed = [int(m[1]) for p in self.path.glob("resume-*.json") if (m := _RESUME(p.name))]
        return 1 + max(resumed, default=0)

    @property
    def stop(self) -> dict[str, Any] | None:
        """Stop document of the last attempt; None if the last attempt was interrupted.

        Raises:
            DataError: The stop document of the run is damaged.
        """
        return self.stop_of(self.attempts - 1)

    def stop_of(self, attempt: int) -> dict[str, Any] | None:
        """Return the stop document of one attempt; None if the document does not exist.

        Raises `DataError`.
        """
        path = self.path / name_of_attempt("stop.json", attempt)
        return read_json(path) if path.exists() else None

    @property
    def status(self) -> RunStatus:
        """Outcome of the run; `interrupted` if the last attempt has no stop document."""
        stop = self.stop
        if stop is None:
            return "interrupted"
        for outcome in _OUTCOMES:
            if stop.get("outcome") == outcome:
                return outcome
        raise DataError(
            f"{self.path / name_of_attempt('stop.json', self.attempts - 1)} names no known outcome",
            hint="the run directory is damaged or was edited: restore it from a backup",
        )

    @property
    def is_judged(self) -> bool:
        """Whether the run has a verdict.

        A verdict exists only if all planned data have been recorded.
        """
        return (self.path / _VERDICT).is_file()

    @property
    def is_reported(self) -> bool:
        """Whether the run has a verdict and a report that shows this verdict."""
        return self.is_judged and (self.path / _REPORT).is_file()

    def write_verdict(self, document: Mapping[str, Any]) -> None:
        """Store the verdict of the run and delete an older report.

        A report therefore always shows the present verdict.

        Raises:
            RecordingError: The run already has a verdict, or the verdict file cannot be written.
        """
        # `write_json` below rejects a second verdict, and the report shows the first verdict
        if not self.is_judged:
            (self.path / _REPORT).unlink(missing_ok=True)
        self.write_json(_VERDICT, document)

    @property
    def recordings(self) -> tuple[Path, ...]:
        """Paths of all recordings of the run in order, including unfinished files.

        The order is that of attempts and parts.
        """
        folder = self.path / "recording"
        return recordings_in(folder) if folder.is_dir() else ()

    @property
    def events_path(self) -> Path:
        """Path of the event log of the run."""
        return self.path / _EVENTS

    def next_attempt(self) -> int:
        """Return the number of an attempt that begins now and that no existing file uses."""
        recorded = [attempt_of(path) + 1 for path in self.recordings]
        begun = self.attempts if (self.path / "start.json").exists() else 0
        return max([begun, *recorded])

    def part_path(self, attempt: int, part: int = 0) -> Path:
        """Return the path of a part of the recording of an attempt; part 0 is the first."""
        return self.path / "recording" / part_name(attempt, part)

    def event_log(self) -> EventLog:
        """Open the event log of the run for appending."""
        return EventLog(self.events_path)

    def events(self) -> list[dict[str, Any]]:
        """Return the events that were logged so far."""
        return read_events(self.events_path)

    def write_text(self, name: str, text: str) -> None:
        """Store a text file in the run directory, such as spec.yaml or station.yaml.

        Raises `RecordingError` if the text file exists already.
        """
        write_once(self.path / name, text.encode())

    def write_json(self, name: str, document: Any) -> None:
        """Store a JSON document in the run directory, such as the plan or the preflight results.

        Raises `RecordingError` if the document exists already.
        """
        write_once(self.path / name, json_document(document))

    def write_start(self, document: Mapping[str, Any]) -> None:
        """Store the start document of the run.

        The function `collect_provenance` returns most of the content of the start document,
        including `uid`.
        """
        self.write_json("start.json", {"hil_run": RUN_FORMAT_VERSION, **document})

    def write_resume(self, attempt: int, document: Mapping[str, Any]) -> None:
        """Store the start document of an attempt that resumes the run.

        Raises:
            RecordingError: The start document exists already or cannot be written.
        """
        name = name_of_attempt("resume.json", attempt)
        with contextlib.suppress(OSError):  # preflight reports a full disk
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
        """Store the stop document with the SHA-256 checksum of every file of the run.

        Storing the stop document is the last action of an attempt.

        Args:
            outcome: Outcome of the attempt that ended.
            reason: Reason for the outcome as readable text.
            document: Counts of the whole run, such as gaps, duplicates and overruns.
            attempt: Number of the attempt that ended; 0 for the first attempt.
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
        """Return one line for each file that differs from its checksum in the stop document.

        The newest stop document of the run is used.

        The event log can be longer than when the stop document was written: the old content must be
        unchanged, and every added line must be an event. Recordings that were deleted on purpose
        (`pruned.json`) are not reported as missing.
        """
        ends = (self.stop_of(attempt) for attempt in reversed(range(self.attempts)))
        stop = next((end for end in ends if end is not None), {})
        recorded = stop.get("sha256", {})
        if not isinstance(recorded, dict):
            return ["stop.json contains no checksums"]
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
        """Names of recordings that were deleted on purpose.

        Raises:
            DataError: The list of deleted recordings is damaged.
        """
        note = self.path / PRUNED
        deleted = read_json(note).get("bytes") if note.exists() else None
        return frozenset(deleted if isinstance(deleted, dict) else ())

    def foreign_events(self) -> list[str]:
        """Return a list with one problem if the event log contains a line that is not an event.

        The returned list is empty if all lines are events.
        """
        lines = foreign_lines(self.events_path)
        held = "1 line that is not an event" if lines == 1 else f"{lines} lines that are not events"
        return [f"{_EVENTS} contains {held}: a different program wrote to it"] if lines else []

    def _checksums(self) -> dict[str, Any]:
        inside = (path for path in self.path.rglob("*") if path.is_file())
        names = {path.relative_to(self.path): path for path in sorted(inside)}
        # Views (report, studies, hidden files) can be created again, so they get no checksum.
        kept = {
            name: path
            for name, path in names.items()
            if name != _REPORT
            and name.parts[0] != _STUDIES
            and not any(part.startswith(".") for part in name.parts)
            # A recording of a recorder that did not stop still changes, so it gets no checksum.
            and not _is_being_written(path)
        }
        try:
            sums = {name.as_posix(): sha256_of(path) for name, path in kept.items()}
            log = self.events_path
            return {"sha256": sums, "events_bytes": log.stat().st_size if log.exists() else 0}
        except OSError as error:
            raise RecordingError(
                f"cannot read {self.path} back: {error}",
                hint="recover its recordings with: hil recover RUN",
            ) from error


def name_of_attempt(name: str, attempt: int) -> str:
    """Return the name of a stop document: `stop.json`, for later attempts `stop-01.json`, …."""
    path = Path(name)
    return f"{path.stem}-{attempt:02d}{path.suffix}" if attempt else name


def number_of(run: Path) -> int:
    """Return the number in the name of a run directory, or 0 if the name has no number."""
    match = _NUMBERED.fullmatch(run.name)
    return int(match[1]) if match else 0


def name_for_path(name: str) -> str:
    """Return a valid folder name: lower case, no separators, not empty and not hidden."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "run"


def is_run(path: Path) -> bool:
    """Return whether a folder is a run, recognized by its name or its start document.

    A damaged run still counts as a run. Folders of series and fleets are stored next to runs and do
    not count as runs.
    """
    # `Path.exists` raises for a folder of a different user without search permission.
    return number_of(path) > 0 or os.path.exists(path / "start.json")


def run_folders(runs_root: Path) -> list[Path]:
    """Return every folder at `DAY/ROBOT/RUN` that can be a run directory.

    Folders that another process removes during the search are skipped.
    """
    days = folders_in(Path(runs_root))
    return [run for day in days for robot in folders_in(day) for run in folders_in(robot)]


def folders_in(parent: Path) -> list[Path]:
    """Return the visible subfolders of a folder, sorted by name.

    A folder that cannot be read yields an empty list.
    """
    try:
        return _folders_in(parent)
    except OSError:
        return []


def _folders_in(parent: Path) -> list[Path]:
    with os.scandir(parent) as entries:
        found = [entry for entry in entries if entry.is_dir()]
    # Raise if the names are readable but the entries cannot be opened.
    os.stat(os.path.join(parent, "."))
    return sorted(Path(entry) for entry in found if not entry.name.startswith("."))


def unreadable_folders(runs_root: Path) -> list[tuple[Path, str]]:
    """Return the unreadable folders that `run_folders` skips, with the system errors.

    The function checks the folder of all runs and the folders of days and robots.
    """
    unreadable: list[tuple[Path, str]] = []

    def inside(folder: Path) -> list[Path]:
        try:
            return _folders_in(folder)
        except (FileNotFoundError, NotADirectoryError):  # the folder was removed in the meantime
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
    """Run number reserved for this process, with a hidden folder in which the run is prepared.

    A run number belongs to the process that holds the lock file `ROOT/.claim-NNNN`. Only the
    process that holds the lock of a run number creates, renames or removes its folder
    `.draft-NNNN`. The draft folder is in the same parent folder as the final run directory, so that
    the rename stays on one file system.

    Attributes:
        number: Run number, which is unique below `ROOT`.
        draft: Hidden folder in which the run is prepared.
    """

    number: int
    draft: Path

    def become(self, run: Path) -> None:
        """Rename the draft folder to the run directory, which has the same parent folder.

        Raises:
            OSError: The draft folder cannot be renamed.
        """
        fsync_directory(self.draft)
        self.draft.rename(run)
        fsync_directory(run.parent)


@contextlib.contextmanager
def claimed(root: Path, folder: Path) -> Iterator[Claim]:
    """Reserve the next free run number under `root` and create a draft folder in `folder`.

    The argument `folder` is `ROOT/DAY/ROBOT`. Draft folders of processes that have exited are
    removed first. The new draft folder is removed when the context ends, unless the draft folder
    has been renamed to a run directory.

    Raises:
        OSError: One of the folders is not writable.
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
            continue  # the lock file belongs to a different user
        if not isinstance(lock, LockFile):
            continue
        with contextlib.ExitStack() as undo:
            undo.enter_context(lock)
            # Check only after locking: before that, a different process could create a run with
            # this number.
            if any(number_of(run) == number for run in run_folders(root)):
                continue
            _remove_drafts(root, path)
            draft = folder / _draft_of(path)
            try:
                draft.mkdir()
            except FileExistsError:
                continue  # abandoned draft of a different user, which only its owner may remove
            undo.pop_all()
            return lock, Claim(number, draft)


def _remove_abandoned(root: Path) -> None:
    """Remove the lock files and draft folders that exited processes left behind."""
    for path in root.glob(f"{_CLAIM}*"):
        if holder_of(path) is not None:
            continue
        with contextlib.suppress(OSError):
            lock = hold(path)
            if isinstance(lock, LockFile):
                with lock:
                    _remove_drafts(root, path)


def _remove_drafts(root: Path, claim: Path) -> None:
    """Remove every draft folder of a run number.

    The caller must hold the lock of this number.
    """
    for day in folders_in(root):
        for robot in folders_in(day):
            shutil.rmtree(robot / _draft_of(claim), ignore_errors=True)


def _draft_of(claim: Path) -> str:
    return _DRAFT + claim.name.removeprefix(_CLAIM)


def reserve(run: Path) -> None:
    """Reserve 1 MiB of disk space for a run.

    The space is released when the stop document is written.

    Raises:
        OSError: Less than 1 MiB of disk space is available.
    """
    descriptor = os.open(run / RESERVE, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        # Random bytes, because a file system can compress or skip zeros. A nearly full disk accepts
        # only a part of the bytes.
        if os.write(descriptor, os.urandom(RESERVE_BYTES)) < RESERVE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def release(run: Path) -> None:
    """Release the disk space that `reserve` has allocated for the run.

    Idempotent.
    """
    with contextlib.suppress(OSError):
        (run / RESERVE).unlink()


def _changed(path: Path, name: str, digest: object, length: object) -> str:
    if not path.is_file():
        return "" if _lives_on(path, digest) else f"{name} is missing"
    known = length if isinstance(length, int) else None
    return "" if sha256_of(path, known) == digest else f"{name} has changed since the run ended"


def _lives_on(torn: Path, digest: object) -> bool:
    """Return whether a torn recording is missing because it was recovered.

    A recovery moves the file aside, renames it or rebuilds it.
    """
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
    """Return whether a process is writing or renaming a recording at present."""
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
