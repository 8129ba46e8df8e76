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
"""

from __future__ import annotations

import contextlib
import errno
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

from hil.core import (
    DataError,
    RecordingError,
    json_document,
    read_json,
    require_known_version,
    sha256_of,
    write_once,
)
from hil.recording.events import EventLog, foreign_lines, read_events
from hil.recording.numbering import claimed, name_for_path, number_of
from hil.recording.parts import attempt_of, name_of_attempt, part_name, recordings_in
from hil.recording.provenance import utc_now
from hil.recording.reserve import release, reserve
from hil.recording.torn_names import in_hand, lives_on

RUN_FORMAT_VERSION = 1

Outcome = Literal["completed", "stopped", "tripped", "failed"]
RunStatus = Literal["completed", "stopped", "tripped", "failed", "interrupted"]

_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
PRUNED = "pruned.json"
"""Says which recordings a policy has deleted, when and whose it was."""

_EVENTS = "events.jsonl"
_REPORT = Path("report.html")
_VERDICT = "verdict.json"
_STUDIES = "study"
_RESUME = re.compile(r"resume-(\d\d+)\.json").fullmatch


FULL = (errno.ENOSPC, errno.EDQUOT)


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
            name: What people shall call the run.
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
                hint=("free the disk, or " if error.errno in FULL else "")
                + "choose another place with --runs DIR",
            ) from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """Open an existing run.

        Raises:
            DataError: It is no run directory, is damaged, or was written by a newer hil.
        """
        run = cls(Path(path))
        if not (run.path / "start.json").is_file():
            raise DataError(
                f"{path} is not a run directory: it has no start.json",
                hint="hil runs lists the runs there are",
            )
        require_known_version(run.path / "start.json", run.start, "hil_run", RUN_FORMAT_VERSION)
        return run

    @property
    def number(self) -> int:
        """The running number, 0 when somebody has renamed the directory."""
        return number_of(self.path)

    @property
    def start(self) -> dict[str, Any]:
        """The start document. Raises `DataError` when it is missing or damaged."""
        return read_json(self.path / "start.json")

    @property
    def attempts(self) -> int:
        """How many attempts have begun: 1, and one more for every resumption."""
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
        """The stop document of one attempt, None if there is none. Raises `DataError`."""
        path = self.path / name_of_attempt("stop.json", attempt)
        return read_json(path) if path.exists() else None

    @property
    def status(self) -> RunStatus:
        """How the run ended; `interrupted` when it never came to write its stop document."""
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
        """Whether there is a verdict: it is about all that the run was to record."""
        return (self.path / _VERDICT).is_file()

    @property
    def is_reported(self) -> bool:
        """Whether there is a verdict, and a report that shows it."""
        return self.is_judged and (self.path / _REPORT).is_file()

    def write_verdict(self, document: Mapping[str, Any]) -> None:
        """Store the verdict; a report from before it goes, so that one that is there shows it.

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
        """Where the event log is."""
        return self.path / _EVENTS

    def next_attempt(self) -> int:
        """The number that an attempt which begins now gets: no file of an older one has it."""
        recorded = [attempt_of(path) + 1 for path in self.recordings]
        begun = self.attempts if (self.path / "start.json").exists() else 0
        return max([begun, *recorded])

    def next_recording(self) -> Path:
        """The path of the next attempt's recording."""
        recorded = [attempt_of(path) for path in self.recordings]
        return self.part_path(max(recorded, default=-1) + 1)

    def part_path(self, attempt: int, part: int = 0) -> Path:
        """Where a part of an attempt's recording belongs; part 0 is its beginning."""
        return self.path / "recording" / part_name(attempt, part)

    def event_log(self) -> EventLog:
        """Open the event log for appending."""
        return EventLog(self.events_path)

    def events(self) -> list[dict[str, Any]]:
        """The events logged so far."""
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
        """What differs from the checksums of the newest stop document, one line per file.

        The event log may have grown since: what it held then must be there still, and what came
        must be events. Recordings that were deleted on purpose (`pruned.json`) are not missed.
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
        told = read_json(note).get("bytes") if note.exists() else None
        return frozenset(told if isinstance(told, dict) else ())

    def foreign_events(self) -> list[str]:
        """What in the event log nobody of ours wrote, in words; nothing where all is well."""
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
            and not in_hand(path)  # of a recorder that could not end: it changes still
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


def _changed(path: Path, name: str, digest: object, length: object) -> str:
    if not path.is_file():
        return "" if lives_on(path, digest) else f"{name} is missing"
    known = length if isinstance(length, int) else None
    return "" if sha256_of(path, known) == digest else f"{name} has changed since the run ended"
