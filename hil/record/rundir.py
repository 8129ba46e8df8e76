"""The run directory: the file format of a run (described in docs/reference/files.md).

::

    runs/2026-11-21/ur5/0042-fourier-p3kg/   the name is for people; identity is start.json:uid
      start.json      who, what, when, with which versions
      spec.yaml  station.yaml  plan.json  preflight.json
      recording/00.mcap …                    one file per attempt, NN.mcap.partial while open
      events.jsonl    state changes, checkpoints, prompts and answers, trips
      stop.json       outcome, reason, counts, SHA-256 per file; written last

No `stop.json` means *interrupted*. No file is ever rewritten.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

from hil.errors import DataError, RecordingError
from hil.record.events import EventLog, read_events
from hil.record.files import (
    fsync_directory,
    json_document,
    read_json,
    require_known_version,
    sha256_of,
    write_once,
)
from hil.record.numbering import claim, name_for_path, number_of
from hil.record.provenance import utc_now
from hil.record.writer import PARTIAL_SUFFIX

RUN_FORMAT_VERSION = 1

Outcome = Literal["completed", "stopped", "tripped", "failed"]
RunStatus = Literal["completed", "stopped", "tripped", "failed", "interrupted"]

_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
_RECORDING = re.compile(rf"(\d\d+)\.mcap({re.escape(PARTIAL_SUFFIX)})?")


@dataclass(frozen=True)
class RunDirectory:
    """One run on disk; use `create` for a new one and `open` for one that exists.

    Attributes:
        path: The directory.
    """

    path: Path

    @classmethod
    def create(cls, runs_root: Path, robot: str, name: str) -> RunDirectory:
        """Make the directory of a new run, with the next free number under `runs_root`.

        Processes may do this at the same time: no two runs get the same number.

        Args:
            runs_root: The folder of all runs; made when missing.
            robot: Name of the robot in the station.
            name: What people shall call the run.

        Raises:
            RecordingError: The directory cannot be made.
        """
        folder = (
            Path(runs_root) / datetime.now().astimezone().date().isoformat() / name_for_path(robot)
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path = claim(Path(runs_root), folder, name_for_path(name))
            (path / "recording").mkdir()
            fsync_directory(path)
            fsync_directory(folder)
        except OSError as error:
            raise RecordingError(
                f"cannot create a run directory in {folder}: {error.strerror or error}",
                hint="free the disk, or choose another place with --runs DIR",
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
    def stop(self) -> dict[str, Any] | None:
        """The stop document, None for an interrupted run. Raises `DataError` when damaged."""
        path = self.path / "stop.json"
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
        raise DataError(f"{self.path / 'stop.json'} names no known outcome")

    @property
    def recordings(self) -> tuple[Path, ...]:
        """The recordings in the order of the attempts, unfinished ones included."""
        folder = self.path / "recording"
        files = folder.iterdir() if folder.is_dir() else ()
        found = [(int(match[1]), path) for path in files if (match := _recording(path))]
        return tuple(path for _, path in sorted(found))

    @property
    def events_path(self) -> Path:
        """Where the event log is."""
        return self.path / "events.jsonl"

    def next_recording(self) -> Path:
        """The path of the next attempt's recording."""
        taken = [int(match[1]) for path in self.recordings if (match := _recording(path))]
        return self.path / "recording" / f"{max(taken, default=-1) + 1:02d}.mcap"

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

    def write_stop(
        self, outcome: Outcome, reason: str, document: Mapping[str, Any] | None = None
    ) -> None:
        """Store the stop document with the SHA-256 of every file; the last thing a run does.

        Args:
            outcome: How the run ended.
            reason: Why, in words for people.
            document: Counts, gaps, duplicates, overruns, … of the whole run.
        """
        self.write_json(
            "stop.json",
            {
                "hil_run": RUN_FORMAT_VERSION,
                "outcome": outcome,
                "reason": reason,
                "stopped": utc_now(),
                **(document or {}),
                "sha256": self._checksums(),
            },
        )

    def verify(self) -> list[str]:
        """What differs from the checksums of the stop document, one line per file."""
        recorded = (self.stop or {}).get("sha256", {})
        if not isinstance(recorded, dict):
            return ["stop.json holds no checksums"]
        problems = []
        for name, digest in recorded.items():
            path = self.path / name
            if not path.is_file():
                problems.append(f"{name} is missing")
            elif sha256_of(path) != digest:
                problems.append(f"{name} has changed since the run ended")
        return problems

    def _checksums(self) -> dict[str, str]:
        paths = sorted(path for path in self.path.rglob("*") if path.is_file())
        try:
            return {path.relative_to(self.path).as_posix(): sha256_of(path) for path in paths}
        except OSError as error:
            raise RecordingError(f"cannot read {self.path} back: {error}") from error


def _recording(path: Path) -> re.Match[str] | None:
    return _RECORDING.fullmatch(path.name)
