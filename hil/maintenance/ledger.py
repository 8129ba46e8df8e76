"""The ledger of a schedule: the result of everything that was due, one JSON line per event.

    STATE/ledger.jsonl          only appended to; every line carries the digest of the one before
    STATE/occasions/ID/         what the work of an occasion has done so far (`stages`)
    STATE/.lock                 held by the process that runs the schedule

An occasion is a job that was due at some time; it is done once. `started` says from when on
occasions are due. Everything due up to the latest `until` is settled, but for the occasion that is
open: put off (`deferred`), or `begun` and not ended. It ends as `done`, `failed`, `held` or
`missed`. Occasions that are left out are `missed`: one line for all that share a reason.

From `held` to `released` nothing begins. A schedule is held by a person, by an occasion that ended
badly at the robot (the robot has to be inspected before it moves again), and by a clock that cannot
be right.

`Standing.after` is the state after each line, of the occasion that is open and of the schedule:

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

One process runs the schedule; others add `held` and `released`, each line under a lock of the file.
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
    """A job that is due at some time.

    Attributes:
        due: When, in UTC.
        job: `probe` (and what follows from it), or the whole `campaign`.
    """

    due: datetime
    job: Job

    @property
    def id(self) -> str:
        """Unique within a schedule, and a valid folder name: `20261128T030000Z-probe`."""
        return f"{self.due.astimezone(UTC):%Y%m%dT%H%M%SZ}-{self.job}"


@lru_cache(maxsize=1024)
def occasion_of(text: str) -> Occasion:
    """Return the occasion of an `Occasion.id`. Raises `ValueError` if it is none."""
    moment, _, job = text.partition("-")
    if job not in get_args(Job):
        raise ValueError(f"{text!r} is no occasion")
    due = datetime.strptime(moment, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    return Occasion(due, "probe" if job == "probe" else "campaign")


class Work(Protocol):
    """Does the job of an occasion, or continues it after a crash."""

    def __call__(self, occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        """Do the job; what `folder` says is done is not done again.

        Args:
            occasion: What is due.
            folder: Of this occasion alone; the same whenever it is continued.

        Returns:
            The result, for the ledger and notifications: at least `text` (one line) and `outcome`
            (`quiet`, `drift`, `promoted`, `kept`).

        Raises:
            HilError: It could not be done, or not to its end.
        """


LEDGER_FILE, OCCASIONS = "ledger.jsonl", "occasions"
Line = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Standing:
    """The state of a schedule after some lines of its ledger.

    Attributes:
        anchor: The minute in which the schedule was first started; None before that.
        until: Everything due until then is settled, but for the open occasion.
        open: An occasion that was begun or put off, and has not ended; None without one.
        begun: Whether the open occasion was begun.
        why: Why it was last put off; empty if it was not.
        touched: Time of the last line about the open occasion.
        held: The line that holds the schedule; None if it is not held.
    """

    anchor: datetime | None = None
    until: datetime | None = None
    open: Occasion | None = None
    begun: bool = False
    why: str = ""
    touched: datetime | None = None
    held: Line | None = None

    def after(self, line: Line) -> Standing:
        """Return the state after one more line. Raises `ValueError` or `KeyError` at nonsense."""
        event, at = line["event"], datetime.fromisoformat(line["at"])
        if event == "started":
            anchor = datetime.fromisoformat(line["anchor"])
            return Standing(anchor=anchor, until=anchor - timedelta(seconds=1))
        if event == "released" and "anchor" in line:
            # The clock was wrong before, and what was settled by it is not settled.
            anchor, until = (datetime.fromisoformat(line[key]) for key in ("anchor", "until"))
            return Standing(anchor=anchor, until=until)
        now = self
        if "until" in line:
            until = datetime.fromisoformat(line["until"])
            # A clock that was put back settles nothing twice.
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
            # The open occasion is due before all others: it is the first that is left out, or none.
            return closed if self.open is not None and self.open.id == line["since"] else now
        return closed if event in ("done", "failed") else now


class Ledger:
    """The lines of a ledger, and the state after them.

    Args:
        folder: Of the state; None for a ledger in memory alone, to forecast what would happen.
        lines: What is in it already.
    """

    def __init__(self, folder: Path | None = None, lines: tuple[Line, ...] = ()) -> None:
        self.folder = folder
        self._load(lines)

    @classmethod
    def read(cls, folder: Path) -> Ledger:
        """Return the ledger of a folder; a line that a crash has torn is none.

        Raises:
            DataError: A line is damaged, or not the one that followed the line before.
        """
        return cls(folder, tuple(_read_linked(folder / LEDGER_FILE)))

    def folder_of(self, occasion: Occasion) -> Path:
        """Return the folder of an occasion; made when missing, unless the ledger is in memory.

        Raises:
            RecordingError: It cannot be made.
        """
        path = (self.folder or Path()) / OCCASIONS / occasion.id
        if self.folder is not None:
            _make_folder(path)
        return path

    def add(self, event: str, at: datetime, **more: Any) -> Line:
        """Add a line, which is on the disk when this returns.

        Raises:
            DataError: The ledger was damaged meanwhile.
            RegistryError: It cannot be written.
        """
        with self._writing():
            content = {"event": event, "at": time_text(at), **more, "before": self._digest()}
            line: Line = json.loads(json_line(content))  # as it will be read again: no NaN
            if self.folder is not None:
                append_line(self.folder / LEDGER_FILE, line)
                self._seen = _size(self.folder / LEDGER_FILE)
            self._take(line)
        return line

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Lock the file while inside, and know what others have added."""
        if self.folder is None:
            yield
            return
        with _locked(self.folder / LEDGER_FILE):
            self.refresh()
            yield

    def refresh(self) -> None:
        """Read the lines that others have added.

        Raises:
            DataError: The ledger was damaged meanwhile.
        """
        if self.folder is not None and (size := _size(self.folder / LEDGER_FILE)) != self._seen:
            path, count = self.folder / LEDGER_FILE, len(self.lines)
            for line in _read_linked(path, count, self._digest(), self.standing):
                self._take(line)
            self._seen = size

    def start(self, name: str, now: datetime) -> None:
        """Add that the schedule was started, if it has not been before.

        Raises:
            DataError: It is the ledger of another schedule.
        """
        if self.standing.anchor is None:
            # A timer that fires at 03:00 gets here a little later, and 03:00 is due all the same.
            anchor = now.astimezone(UTC).replace(second=0, microsecond=0)
            self.add("started", now, name=name, anchor=time_text(anchor))
        self.require_of(name)

    def require_of(self, name: str) -> None:
        """Raise if it is the ledger of another schedule; an empty one is fine.

        Raises:
            DataError: It is one.
        """
        if self.lines and (own := self.lines[0].get("name")) != name:
            raise DataError(
                f"{self.folder} is the state of the schedule {own!r}, not of {name!r}",
                hint="give every schedule a folder of its own with --state",
            )

    def reload(self) -> None:
        """Read all lines again, as after an interrupt between writing a line and taking it."""
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
            f"cannot make {folder}: {error.strerror or error}", hint="name another with --state"
        ) from error


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _read_linked(
    path: Path, skip: int = 0, before: str = "", standing: Standing | None = None
) -> Iterator[Line]:
    """Yield the lines of a ledger, each with the digest of the one before it.

    Args:
        path: The file.
        skip: Number of lines that are known already.
        before: Digest of the last of these.
        standing: State after these.

    Raises:
        DataError: A line is damaged, or not the one that followed the line before.
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
    """Lock a file while inside; the lock goes with the descriptor, however this process ends."""
    try:
        with path.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise RegistryError(
            f"cannot write {path}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def _digest(line: Line) -> str:
    return hashlib.sha256(json_text(line).encode()).hexdigest()


@contextmanager
def open_ledger(folder: Path, name: str) -> Iterator[Ledger]:
    """Return the ledger of a folder, with the folder locked while inside.

    Args:
        folder: Of the state; made when missing.
        name: Of the schedule.

    Raises:
        DataError: Another process runs the schedule, or the ledger is damaged.
        RecordingError: The folder cannot be written to.
    """
    _make_folder(folder)

    def busy(holder: Holder) -> DataError:
        return DataError(
            f"the schedule in {folder} is run by {holder}",
            hint=f"stop that one first, or look at it: hil schedule show FILE --state {folder}",
        )

    with hold_folder(folder, busy, {"schedule": name}, hint="name another with --state"):
        yield Ledger.read(folder)


def time_text(moment: datetime) -> str:
    """Return a moment as the ledger has it: UTC, whole seconds."""
    return moment.astimezone(UTC).isoformat(timespec="seconds")


def needs_inspection(error: Exception) -> bool:
    """Return whether the cause may persist at the robot: an interlock, a fault, a stop by hand.

    A robot that could not be reached is looked at before it moves again in any case, and a failure
    without it (a fit, a disk) says nothing of it.
    """
    if isinstance(error, Stopped):
        return not error.by_signal
    if isinstance(error, RobotError):
        return not isinstance(error, RobotConnectionError)
    return isinstance(error, InterlockTripped)


AHEAD = timedelta(days=1)
"""A ledger so far ahead of the clock was written with another clock; no time zone is so far off."""


def clock_problem(standing: Standing, now: datetime) -> str:
    """Return why the clock is, or was, wrong; empty if it may be right."""
    if standing.until is None or standing.until <= now + AHEAD:
        return ""
    return (
        f"the clock shows {time_text(now)}, and everything is settled until "
        f"{time_text(standing.until)}: set the clock, or release the schedule from now on"
    )


def hold(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Hold a schedule: nothing begins from now on, but an occasion under way comes to its end.

    Args:
        ledger: Of the schedule.
        now: The present moment.
        reason: In words.
        by: Recorded; by default the user of this process.

    Raises:
        DataError: It is held already.
        RegistryError: It cannot be written.
    """
    if (held := ledger.standing.held) is not None:
        raise DataError(
            f"the schedule is held already: {held['why']}", hint="hil schedule show FILE"
        )
    return ledger.add("held", now, why=reason, by=by or operator())


def release(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Release a schedule; if its ledger is ahead of the clock, occasions are due from now on.

    Args:
        ledger: Of the schedule.
        now: The present moment.
        reason: In words.
        by: Recorded; by default the user of this process.

    Raises:
        DataError: Nothing holds it.
        RegistryError: It cannot be written.
    """
    standing, restart = ledger.standing, {}
    if standing.anchor is not None and clock_problem(standing, now):
        restart = {"anchor": time_text(min(standing.anchor, now)), "until": time_text(now)}
    elif standing.held is None:
        raise DataError("the schedule is not held", hint="hil schedule show FILE")
    return ledger.add("released", now, why=reason, by=by or operator(), **restart)
