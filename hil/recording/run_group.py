"""Run groups: runs that were started together as a series or a fleet, with their outcomes.

::

    runs/2026-11-21/series/series-both/series.json   {hil_series_run: 1, name, …, runs: [entry]}
                                       series.html
    runs/2026-11-21/fleet/fleet-lab/fleet.json       {hil_fleet_run: 1, name, …, members: [entry]}
                                    specs/ROBOT.yaml the spec as each robot runs it
                                    models/  fleet.html
                                    .lock            held while a process works on the group

The document of a group (header and one entry per run) is only a view: the run directories contain
the authoritative data, and the document is replaced after every change. The document of a group is
stored in the folder of runs and refers to the runs by relative paths, so that the whole folder can
be moved.

The document of a series lists the experiments that have begun, in order. The document of a fleet
lists all robots of the fleet from the start. The spec of each robot of a fleet is a separate file,
which is written before any robot moves and is named in the `start.json` of the run. Each run of a
fleet therefore identifies its fleet even if the process that wrote the group document was killed.

A schedule is not a run group: its ledger and its occasions contain more than a list of runs, and
each run names its occasion (decision 0038).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Self

from hil.core import (
    DataError,
    HilError,
    Rejected,
    Stopped,
    errors,
    hold_folder,
    json_document,
    new_folder,
    read_json,
    require_known_version,
    write_once,
    write_replacing,
)
from hil.recording.run_directory import folders_in, name_for_path, run_folders

GROUP_FORMAT = 1

Document = dict[str, Any]

_PATHS = ("run", "report")
"""Keys of a group entry whose values are file paths."""


@dataclass(frozen=True, slots=True)
class Member:
    """State of one run that belongs to a group.

    Attributes:
        experiment: Name of the experiment that was run.
        robot: Name of the robot that ran the experiment.
        report: Report of the run as printed by `hil run --json`; empty if no run directory exists.
        error: Error that ended the run early, or problem with its models; None if there is no
            error.
    """

    experiment: str
    robot: str
    report: Document
    error: HilError | None = None

    @property
    def run(self) -> Path | None:
        """Path of the run directory; None if no run directory exists."""
        run = self.report.get("run")
        return Path(run) if isinstance(run, str) and run else None

    @property
    def measured(self) -> bool:
        """Whether the robot completed all motions; only then can the next experiment start."""
        return self.report.get("outcome") == "completed" and not isinstance(self.error, Stopped)

    @property
    def word(self) -> str:
        """Outcome of the run, or verdict on its models, in one or a few words."""
        outcome = str(self.report.get("outcome", "not run"))
        if not self.measured:
            return outcome if outcome != "completed" else "stopped after the motion"
        return str(self.report.get("verdict"))

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Member:
        """Return the group member that `to_dict` converted.

        A stored error of an unknown class becomes a `HilError`.
        """
        own = ("experiment", "robot", "error")
        report = {key: value for key, value in entry.items() if key not in own}
        document, error = entry.get("error"), None
        if isinstance(document, dict):
            kind = getattr(errors, str(document.get("kind")), None)
            if not (isinstance(kind, type) and issubclass(kind, HilError)):
                kind = HilError
            error = kind(str(document.get("message")), hint=str(document.get("hint") or ""))
        return cls(str(entry.get("experiment")), str(entry.get("robot")), report, error)

    def to_dict(self) -> Document:
        """Return the entry of the run for the group document and for `--json`."""
        error = self.error and {"kind": type(self.error).__name__, "message": self.error.message}
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            **self.report,
            **({"error": error} if error else {}),
        }


def worst_error(members: Iterable[Member]) -> HilError | None:
    """Return the most severe error of a group; None if no member of the group has an error.

    The order from the most to the least severe error is: a stop, a run that ended early, missing
    models, a rejected model.
    """

    def rank(member: Member) -> tuple[bool, bool, bool]:
        error = member.error
        return not isinstance(error, Stopped), member.measured, isinstance(error, Rejected)

    wrong = [member for member in members if member.error is not None]
    return min(wrong, key=rank).error if wrong else None


@dataclass(frozen=True)
class RunGroup:
    """Folder of a run group; base class of `SeriesGroup` and `FleetGroup`.

    Attributes:
        path: Path of the group folder.
        head: Header of the group document, which is the document without its entries.
    """

    kind: ClassVar[str]
    entries: ClassVar[str]
    """Key of the list of entries in the group document."""
    described: ClassVar[str]
    """Description of the entries, used in error messages."""
    required: ClassVar[tuple[str, ...]] = ()
    """Keys that every entry of the group document must have."""

    path: Path
    head: Mapping[str, Any]

    @classmethod
    def _create(cls, runs: Path, about: Mapping[str, Any], more: Mapping[str, Any]) -> Self:
        """Create the folder of a group that starts now.

        `about` contains the `name` of the group.

        The header of the group document consists of `about`, the start time and `more`, in this
        order.
        """
        now = datetime.now().astimezone()
        above = runs / now.date().isoformat() / cls.kind
        path = new_folder(above, f"{cls.kind}-{name_for_path(about['name'])}")
        started = now.isoformat(timespec="seconds")
        return cls(path, {cls._version_key(): GROUP_FORMAT, **about, "started": started, **more})

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the group that is stored in a folder.

        Raises:
            DataError: The group document is missing, damaged, or from a newer version of hil.
        """
        document = cls._read(path)
        del document[cls.entries]
        return cls(path, document)

    @classmethod
    def is_at(cls, path: Path) -> bool:
        """Return whether a folder contains a group of this kind."""
        return os.path.isfile(cls.document_in(path))  # False without permission to enter the folder

    @classmethod
    def folders(cls, runs: Path) -> list[Path]:
        """Return the group folders of this kind below a folder of runs, oldest day first.

        A folder whose creation was interrupted is not returned, because it has no document yet (see
        `is_at`).
        """
        return [path for day in folders_in(runs) for path in folders_in(day / cls.kind)]

    @classmethod
    def unreadable(cls, runs: Path) -> list[tuple[Path, str]]:
        """Return the group folders that cannot be entered, each with the system error message."""
        refused = []
        for path in cls.folders(runs):
            try:
                os.stat(cls.document_in(path))
            except FileNotFoundError:
                continue
            except OSError as error:
                refused.append((path, error.strerror or str(error)))
        return refused

    @classmethod
    def document_in(cls, path: Path) -> Path:
        """Return the path of the document in a group folder."""
        return path / f"{cls.kind}.json"

    @classmethod
    def page_in(cls, path: Path) -> Path:
        """Return the path of the HTML page of a group folder.

        The HTML page possibly does not exist yet.
        """
        return path / f"{cls.kind}.html"

    def members(self) -> list[Member]:
        """Return the runs of the group according to the present group document.

        Raises:
            DataError: The group document is damaged.
        """
        members = []
        for entry in self._read(self.path)[self.entries]:
            paths = {key: entry[key] for key in _PATHS if isinstance(entry.get(key), str)}
            here = {key: os.path.normpath(self.path / path) for key, path in paths.items()}
            members.append(Member.from_dict({"experiment": self.head.get("name"), **entry, **here}))
        return members

    def write(self, members: Iterable[Member]) -> None:
        """Replace the document.

        Raises:
            RecordingError: The group document cannot be written.
        """
        entries = []
        for entry in (member.to_dict() for member in members):
            paths = {key: entry[key] for key in _PATHS if entry.get(key)}
            seen = {key: os.path.relpath(path, self.path) for key, path in paths.items()}
            entries.append(entry | seen)
        document = {**self.head, self.entries: entries}
        write_replacing(self.document_in(self.path), json_document(document))

    def held(self) -> AbstractContextManager[None]:
        """Return a context manager that locks the group against other processes.

        The operating system releases the lock if this process exits.

        Raises:
            DataError: A different process is working on the group.
            RecordingError: The group folder cannot be locked.
        """
        return hold_folder(
            self.path,
            lambda holder: DataError(
                f"{self.path} is in use by {holder}", hint="wait until that process has ended"
            ),
        )

    @classmethod
    def _version_key(cls) -> str:
        return f"hil_{cls.kind}_run"

    @classmethod
    def _read(cls, path: Path) -> Document:
        """Return the group document after checking the required keys of all entries."""
        file = cls.document_in(path)
        document = read_json(file)
        require_known_version(file, document, cls._version_key(), GROUP_FORMAT)
        entries = document.setdefault(cls.entries, [])
        if not isinstance(entries, list) or not all(
            isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in cls.required)
            for entry in entries
        ):
            raise DataError(
                f"{file}: `{cls.entries}` is not a list of {cls.described}",
                hint="it is damaged or was edited: restore it from a backup",
            )
        return document


class SeriesGroup(RunGroup):
    """Folder of a series, whose experiments run one after the other."""

    kind = "series"
    entries = "runs"
    described = "runs"

    @classmethod
    def create(
        cls,
        runs: Path,
        name: str,
        source: Path,
        *,
        description: str = "",
        station: Path | None = None,
        commissioning: Mapping[str, Any] | None = None,
    ) -> SeriesGroup:
        """Create the folder of a series that starts now.

        Args:
            runs: Path of the folder of all runs.
            name: Name of the series.
            source: Path of the series file, which is needed to resume the series later.
            description: Purpose of the series.
            station: Path of the station file that replaces the stations named in the experiment
                files.
            commissioning: Part of each experiment that is executed, and its speed; None to execute
                everything.

        Raises:
            RecordingError: The series folder cannot be written.
        """
        about = {
            "name": name,
            "description": description,
            "source": str(source.resolve()),
            "station": str(station.resolve()) if station else None,
        }
        more = {"commissioning": dict(commissioning)} if commissioning else {}
        group = cls._create(runs, about, more)
        group.write(())
        return group


class FleetGroup(RunGroup):
    """Folder of a fleet: many robots run the same experiment, some of them at the same time."""

    kind = "fleet"
    entries = "members"
    described = "robots and their runs"
    required = ("robot",)

    @classmethod
    def create(
        cls,
        runs: Path,
        name: str,
        specs: Mapping[str, str],
        source: Path,
        station: str,
        robots: Path | None = None,
    ) -> FleetGroup:
        """Create the folder of a fleet that starts now, with the spec of every robot.

        Args:
            runs: Path of the folder of all runs.
            name: Name of the experiment.
            specs: Text of the spec of each robot, by robot name.
            source: Path of the spec file of the experiment.
            station: Path of the station file; empty for the default station of an experiment next
                to `source`.
            robots: Path of the file with the names and addresses of real robots; None for mock
                robots.

        Raises:
            RecordingError: The fleet folder cannot be written.
        """
        about = {
            "name": name,
            "source": str(source.resolve()),
            "station": station and str(Path(station).resolve()),
        }
        more = {"robots": str(robots.resolve())} if robots else {}
        group = cls._create(runs.resolve(), about, more)
        (group.path / "specs").mkdir()
        for robot, text in specs.items():
            write_once(group.spec_of(robot), text.encode())
        group.write(Member(name, robot, {}) for robot in specs)
        return group

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a fleet as `RunGroup.open` does, but with an absolute path.

        The path is absolute because runs refer to their spec by an absolute path.
        """
        return super().open(path.resolve())

    @property
    def runs(self) -> Path:
        """Folder of runs that contains the fleet."""
        return self.path.parents[2]

    @property
    def models(self) -> Path:
        """Folder of the models that are identified from the runs of the fleet."""
        return self.path / "models"

    def spec_of(self, robot: str) -> Path:
        """Return the path of the spec of one robot of the fleet."""
        return self.path / "specs" / f"{robot}.yaml"

    def run_of(self, robot: str) -> Path | None:
        """Return the newest run of a robot for this fleet.

        A run belongs to the fleet that is identified in the start document of the run.
        """
        mine = self.spec_of(robot).parts[-5:]  # the folder of runs has possibly been moved
        runs = [
            run
            for run in run_folders(self.runs)
            if run.parent.name == name_for_path(robot) and _spec_named_by(run).parts[-5:] == mine
        ]
        return max(runs, key=lambda run: run.name, default=None)

    @staticmethod
    def place_named_by(run: Path) -> tuple[str, ...]:
        """Return `DAY, fleet, fleet-NAME` from the spec path in the start document of a run.

        The returned path is meaningful only if the spec of the run is stored in the folder of a
        fleet.
        """
        return _spec_named_by(run).parts[-5:-2]

    def completed(self) -> list[Path]:
        """Return the runs of the fleet with a complete measurement."""
        return [
            member.run
            for member in self.members()
            if member.run is not None and member.report.get("outcome") == "completed"
        ]


def _spec_named_by(run: Path) -> Path:
    """Return the spec path in the start document of a run.

    The path is empty if the start document is damaged.
    """
    try:
        return Path(str(read_json(run / "start.json").get("spec", "")))
    except DataError:
        return Path()
