"""Ledger of a schedule: results of all due occasions, with one JSON line per event.

    STATE/ledger.jsonl          only appended to; every line carries the digest of the one before
    STATE/occasions/ID/         what the work of an occasion has done so far (`stages`)
    STATE/.lock                 held by the process that runs the schedule

An occasion is a job that is due at a certain time; each occasion is done only one time. The ledger
line `started` contains the time from which occasions are due. All occasions with a due time up to
the latest `until` are settled, except the open occasion. The open occasion was deferred
(`deferred`), or it was `begun` and has not ended. The open occasion ends with a line `done`,
`failed`, `held` or `missed`. Omitted occasions get a line `missed`; one line covers all occasions
that are omitted for the same reason.

No occasion begins between the lines `held` and `released`. A schedule becomes held by a command of
a user, after an error at the robot (because an operator must inspect the robot before it moves
again), or after a wrong clock.

`Standing.after` computes the state of the open occasion and of the schedule after each ledger line:

| state         | line                                        | next state                      |
|---------------|---------------------------------------------|---------------------------------|
| nothing open  | `deferred`                                  | open, put off                   |
| nothing open  | `begun`                                     | open, begun                     |
| open, put off | `begun`                                     | open, begun                     |
| open, begun   | `begun` (again), `deferred`                 | open, begun                     |
| any           | `missed`, `instead` names another occasion  | that one is open, not begun     |
| open          | `done`, `failed`, `missed` from this one on | nothing open                    |
| open          | `held` with its occasion                    | nothing open, the schedule held |
| not held      | `held`                                      | held                            |
| held          | `released`                                  | not held                        |
| any           | `started`, `released` with a new anchor     | nothing open, not held          |

Only one process runs a schedule. Other processes may add the lines `held` and `released`. A file
lock protects the writing of each line.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

from hil.core import (
    DataError,
    Holder,
    InterlockTripped,
    RecordingError,
    RegistryError,
    RobotConnectionError,
    RobotError,
    Stopped,
    hold_folder,
    json_line,
    json_text,
)
from hil.models import append_line, read_lines
from hil.recording import operator

Job = Literal["probe", "campaign"]


@dataclass(frozen=True, slots=True, order=True)
class Occasion:
    """Job that is due at a certain time.

    Attributes:
        due: Due time of the occasion, UTC.
        job: Job of the occasion: `probe` (with the stages that follow from it), or the whole
            `campaign`.
    """

    due: datetime
    job: Job

    @property
    def id(self) -> str:
        """Identifier within a schedule, also a valid folder name: `20261128T030000Z-probe`."""
        return f"{self.due.astimezone(UTC):%Y%m%dT%H%M%SZ}-{self.job}"


@lru_cache(maxsize=1024)
def occasion_of(text: str) -> Occasion:
    """Return the occasion with this `Occasion.id`; raise `ValueError` if the text is invalid."""
    moment, _, job = text.partition("-")
    if job not in get_args(Job):
        raise ValueError(f"{text!r} is not the name of an occasion")
    due = datetime.strptime(moment, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    return Occasion(due, "probe" if job == "probe" else "campaign")


class Work(Protocol):
    """Function that does the job of an occasion, or continues it after a crash."""

    def __call__(self, occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        """Do the job; skip the steps that are already done according to the content of `folder`.

        Args:
            occasion: Occasion to work on.
            folder: Folder that belongs to this occasion only; the same folder is passed when the
                occasion is continued.

        Returns:
            Result for the ledger and for notifications, with at least the keys `text` (one line)
            and `outcome` (`quiet`, `drift`, `promoted`, `kept`).

        Raises:
            HilError: The job failed, or could not be completed.
        """


LEDGER_FILE, OCCASIONS = "ledger.jsonl", "occasions"
Line = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Standing:
    """State of a schedule after a number of lines of its ledger.

    Attributes:
        anchor: Minute of the first start of the schedule; None before the first start.
        until: Time up to which all occasions are settled, except the open occasion.
        open: Open occasion, which was begun or deferred and has not ended; None if there is none.
        begun: Flag; true if the open occasion was begun.
        why: Reason of the last deferral of the open occasion; empty if it was not deferred.
        touched: Time of the last ledger line about the open occasion.
        held: Ledger line that holds the schedule; None if the schedule is not held.
    """

    anchor: datetime | None = None
    until: datetime | None = None
    open: Occasion | None = None
    begun: bool = False
    why: str = ""
    touched: datetime | None = None
    held: Line | None = None

    def after(self, line: Line) -> Standing:
        """Return the state of the schedule after one more ledger line.

        Raises:
            ValueError, KeyError: The ledger line is invalid.
        """
        event, at = line["event"], datetime.fromisoformat(line["at"])
        if event == "started":
            anchor = datetime.fromisoformat(line["anchor"])
            return Standing(anchor=anchor, until=anchor - timedelta(seconds=1))
        if event == "released" and "anchor" in line:
            # The clock was wrong before, so occasions settled by it count as not settled.
            anchor, until = (datetime.fromisoformat(line[key]) for key in ("anchor", "until"))
            return Standing(anchor=anchor, until=until)
        now = self
        if "until" in line:
            until = datetime.fromisoformat(line["until"])
            # `until` never decreases, so that a clock set back repeats no occasion.
            now = replace(self, until=max(until, self.until or until))
        closed = replace(now, open=None, begun=False, why="", touched=None)
        if event == "deferred":
            occasion = occasion_of(line["occasion"])
            return replace(now, open=occasion, why=line["why"], touched=at)
        if event == "begun":
            occasion = occasion_of(line["occasion"])
            return replace(now, open=occasion, begun=True, why="", touched=at)
        if event == "missed" and "instead" in line:
            occasion = occasion_of(line["instead"])
            return now if occasion == now.open else replace(closed, open=occasion, touched=at)
        if event == "released":
            return replace(now, held=None)
        if event == "held":
            return replace(closed if "occasion" in line else now, held=line)
        if event == "missed":
            # The open occasion has the earliest due time: only `since` can be the open one.
            return closed if self.open is not None and self.open.id == line["since"] else now
        return closed if event in ("done", "failed") else now


class Ledger:
    """Lines of a ledger, and the state of the schedule after these lines.

    Args:
        folder: Folder of the schedule's state; None for a ledger in memory, which forecasts use.
        lines: Initial lines.
    """

    def __init__(self, folder: Path | None = None, lines: tuple[Line, ...] = ()) -> None:
        self.folder = folder
        self._load(lines)

    @classmethod
    def read(cls, folder: Path) -> Ledger:
        """Return the ledger in a folder; a torn last line is not included.

        Raises:
            DataError: A line is damaged, or its digest chain to the previous line is broken.
        """
        return cls(folder, tuple(_read_linked(folder / LEDGER_FILE)))

    def folder_of(self, occasion: Occasion) -> Path:
        """Return the folder of an occasion.

        The folder is created unless the ledger is in memory.

        Raises:
            RecordingError: The folder cannot be created.
        """
        path = (self.folder or Path()) / OCCASIONS / occasion.id
        if self.folder is not None:
            _make_folder(path)
        return path

    def add(self, event: str, at: datetime, **more: Any) -> Line:
        """Append a line durably.

        Raises:
            DataError: The ledger file was damaged since it was read.
            RegistryError: The ledger line cannot be written.
        """
        with self._writing():
            content = {"event": event, "at": time_text(at), **more, "before": self._digest()}
            line: Line = json.loads(json_line(content))  # in the form that it is read
            if self.folder is not None:
                append_line(self.folder / LEDGER_FILE, line)
                self._seen = _size(self.folder / LEDGER_FILE)
            self._take(line)
        return line

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Lock the ledger file inside a block, after reading the lines of other processes."""
        if self.folder is None:
            yield
            return
        with _locked(self.folder / LEDGER_FILE):
            self.refresh()
            yield

    def refresh(self) -> None:
        """Read the ledger lines that other processes have added.

        Raises:
            DataError: The ledger file was damaged since it was read.
        """
        if self.folder is not None and (size := _size(self.folder / LEDGER_FILE)) != self._seen:
            path, count = self.folder / LEDGER_FILE, len(self.lines)
            for line in _read_linked(path, count, self._digest(), self.standing):
                self._take(line)
            self._seen = size

    def start(self, name: str, now: datetime) -> None:
        """Add the line `started` to the ledger if it is empty.

        Raises:
            DataError: The ledger belongs to a different schedule.
        """
        if self.standing.anchor is None:
            # A timer that fires at 03:00 gets here slightly later; 03:00 must be due nevertheless.
            anchor = now.astimezone(UTC).replace(second=0, microsecond=0)
            self.add("started", now, name=name, anchor=time_text(anchor))
        self.require_of(name)

    def require_of(self, name: str) -> None:
        """Raise if the ledger belongs to a different schedule; an empty ledger is accepted.

        Raises:
            DataError: The ledger belongs to a different schedule.
        """
        if self.lines and (own := self.lines[0].get("name")) != name:
            raise DataError(
                f"{self.folder} is the state folder of the schedule {own!r}, not of {name!r}",
                hint="use a separate state folder for each schedule: --state FOLDER",
            )

    def reload(self) -> None:
        """Read all ledger lines again from the file.

        Reloading is needed if a line was written but an interrupt prevented storing it in memory.
        """
        if self.folder is not None:
            self._load(tuple(_read_linked(self.folder / LEDGER_FILE)))

    def _load(self, lines: tuple[Line, ...]) -> None:
        self.lines: list[Line] = []
        self.standing = Standing()
        self._seen = -1
        for line in lines:
            self._take(line)

    def _take(self, line: Line) -> None:
        self.standing = self.standing.after(line)
        self.lines.append(line)

    def _digest(self) -> str:
        return _digest(self.lines[-1]) if self.lines else ""


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot create {folder}: {error.strerror or error}",
            hint="name another folder with --state",
        ) from error


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _read_linked(
    path: Path, skip: int = 0, before: str = "", standing: Standing | None = None
) -> Iterator[Line]:
    """Yield the lines of a ledger after checking their digest chain.

    Args:
        path: Ledger file.
        skip: Number of lines that have already been read.
        before: Digest of the last line that has already been read.
        standing: State of the schedule after the lines that have already been read.

    Raises:
        DataError: A line is damaged, or its digest chain to the previous line is broken.
    """
    standing = standing or Standing()
    for number, raw in read_lines(path)[skip:]:
        try:
            line = json.loads(raw)
            standing = standing.after(line)
            linked = line["before"] == before
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise DataError(
                f"{path}:{number}: damaged: {error!r}", hint="restore the file from a backup"
            ) from error
        if not linked:
            raise DataError(
                f"{path}:{number} does not follow the line before it: the ledger was changed",
                hint="restore the file from a backup",
            )
        before = hashlib.sha256(raw).hexdigest()
        yield line


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a file inside a `with` block; the kernel releases the lock if the process dies."""
    try:
        with path.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise RegistryError(
            f"cannot write {path}: {error.strerror or error}",
            hint="check that the folder is writable and that the disk has space",
        ) from error


def _digest(line: Line) -> str:
    return hashlib.sha256(json_text(line).encode()).hexdigest()


@contextmanager
def open_ledger(folder: Path, name: str) -> Iterator[Ledger]:
    """Lock the folder of a schedule's state inside a `with` block, and yield its ledger.

    Args:
        folder: Folder of the state; the folder is created if it does not exist.
        name: Name of the schedule.

    Raises:
        DataError: A different process runs the schedule, or the ledger is damaged.
        RecordingError: The folder of the state cannot be written.
    """
    _make_folder(folder)

    def busy(holder: Holder) -> DataError:
        return DataError(
            f"the schedule in {folder} is run by {holder}",
            hint=f"stop that process first, or see: hil schedule show FILE --state {folder}",
        )

    with hold_folder(folder, busy, {"schedule": name}, hint="name another folder with --state"):
        yield Ledger.read(folder)


def time_text(moment: datetime) -> str:
    """Return a time in the format of the ledger: UTC with whole seconds."""
    return moment.astimezone(UTC).isoformat(timespec="seconds")


def needs_inspection(error: Exception) -> bool:
    """Return whether the cause of an error may still be present at the robot.

    Possible causes at the robot are an interlock, a fault, or a stop by an operator. An unreachable
    robot needs no inspection, because it is checked before it moves again anyway. Errors of other
    components, such as a fit or a disk, have no cause at the robot.
    """
    if isinstance(error, Stopped):
        return not error.by_signal
    if isinstance(error, RobotError):
        return not isinstance(error, RobotConnectionError)
    return isinstance(error, InterlockTripped)


AHEAD = timedelta(days=1)
"""Maximum time by which a ledger may be ahead of the clock. If a ledger is further ahead of the
clock than this maximum, a clock was wrong, because no time zones differ by so much.
"""


def clock_problem(standing: Standing, now: datetime) -> str:
    """Return the reason why the clock is or was wrong; empty if nothing indicates this."""
    if standing.until is None or standing.until <= now + AHEAD:
        return ""
    return (
        f"the clock shows {time_text(now)}, but all occasions until {time_text(standing.until)} "
        "are already settled: set the clock, or release the schedule to continue from now on"
    )


def hold(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Hold a schedule: no further occasion begins, but a running occasion is completed.

    Args:
        ledger: Ledger of the schedule to hold.
        now: Current time.
        reason: Reason for the hold in words.
        by: User to record; empty for the user of this process.

    Raises:
        DataError: The schedule is already held.
        RegistryError: The ledger cannot be written.
    """
    if (held := ledger.standing.held) is not None:
        raise DataError(
            f"the schedule is already held: {held['why']}", hint="see: hil schedule show FILE"
        )
    return ledger.add("held", now, why=reason, by=by or operator())


def release(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Release a held schedule.

    If the ledger is ahead of the clock, occasions are due from now on.

    Args:
        ledger: Ledger of the schedule to release.
        now: Current time.
        reason: Reason for the release in words.
        by: User to record; empty for the user of this process.

    Raises:
        DataError: The schedule is not held.
        RegistryError: The ledger cannot be written.
    """
    standing, restart = ledger.standing, {}
    if standing.anchor is not None and clock_problem(standing, now):
        restart = {"anchor": time_text(min(standing.anchor, now)), "until": time_text(now)}
    elif standing.held is None:
        raise DataError("the schedule is not held", hint="see: hil schedule show FILE")
    return ledger.add("released", now, why=reason, by=by or operator(), **restart)
