"""A run group: runs that were started together, as a series or a fleet, and how each ended.

::

    runs/2026-11-21/series/series-both/series.json   {hil_series_run: 1, name, …, runs: [entry]}
                                       series.html
    runs/2026-11-21/fleet/fleet-lab/fleet.json       {hil_fleet_run: 1, name, …, members: [entry]}
                                    specs/ROBOT.yaml the spec as each robot runs it
                                    models/  fleet.html
                                    .lock            held while a process works on the group

The document (head and one entry per run) is a view: run directories are the truth, and the document
is replaced whenever there is more to say. It lies in the folder of runs and names them by paths
that start at its own folder, so that all of it may be moved together.

A series lists the experiments that have begun, in order. A fleet lists all of its robots from the
start; each robot's spec is a file of its own, written before anything moves and named by the run's
`start.json`. So a run says whose it is even if the process that kept the document was killed.

A schedule is no run group: its ledger and its occasions say more than which runs there are, and
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
"""Keys of an entry whose values are paths."""


@dataclass(frozen=True, slots=True)
class Member:
    """One run of a group, as far as it came.

    Attributes:
        experiment: Its name.
        robot: Name of its robot.
        report: The run's own report as `hil run --json` has it; empty without a run directory.
        error: What ended it early, or what is wrong with its models; None if nothing is.
    """

    experiment: str
    robot: str
    report: Document
    error: HilError | None = None

    @property
    def run(self) -> Path | None:
        """The run directory; None if there is none."""
        run = self.report.get("run")
        return Path(run) if isinstance(run, str) and run else None

    @property
    def measured(self) -> bool:
        """Whether the robot did all it should: the next experiment may move one."""
        return self.report.get("outcome") == "completed" and not isinstance(self.error, Stopped)

    @property
    def word(self) -> str:
        """How it ended, or what its models are worth, in a word or two."""
        outcome = str(self.report.get("outcome", "not run"))
        if not self.measured:
            return outcome if outcome != "completed" else "stopped after the motion"
        return str(self.report.get("verdict"))

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Member:
        """Return what `to_dict` has written; an error of an unknown class is a `HilError`."""
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
        """Return an entry of the document of a group, and of `--json`."""
        error = self.error and {"kind": type(self.error).__name__, "message": self.error.message}
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            **self.report,
            **({"error": error} if error else {}),
        }


def worst_error(members: Iterable[Member]) -> HilError | None:
    """Return the worst error of a group; None if nothing is wrong.

    From the worst: a stop, a run that ended early, models that are missing, a rejected model.
    """

    def rank(member: Member) -> tuple[bool, bool, bool]:
        error = member.error
        return not isinstance(error, Stopped), member.measured, isinstance(error, Rejected)

    wrong = [member for member in members if member.error is not None]
    return min(wrong, key=rank).error if wrong else None


@dataclass(frozen=True)
class RunGroup:
    """The folder of a group; a `SeriesGroup` or a `FleetGroup`.

    Attributes:
        path: The folder.
        head: What its document says besides the entries.
    """

    kind: ClassVar[str]
    entries: ClassVar[str]
    """Key of the entries in the document."""
    described: ClassVar[str]
    """What the entries are, for messages."""
    required: ClassVar[tuple[str, ...]] = ()
    """Keys that an entry has in any case."""

    path: Path
    head: Mapping[str, Any]

    @classmethod
    def _create(cls, runs: Path, about: Mapping[str, Any], more: Mapping[str, Any]) -> Self:
        """Make the folder of a group that starts now; `about` has its `name`.

        The head of the document has `about`, when it was started, and `more`, in this order.
        """
        now = datetime.now().astimezone()
        above = runs / now.date().isoformat() / cls.kind
        path = new_folder(above, f"{cls.kind}-{name_for_path(about['name'])}")
        started = now.isoformat(timespec="seconds")
        return cls(path, {cls._version_key(): GROUP_FORMAT, **about, "started": started, **more})

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the group of a folder.

        Raises:
            DataError: It has no document, a damaged one, or one of a newer hil.
        """
        document = cls._read(path)
        del document[cls.entries]
        return cls(path, document)

    @classmethod
    def is_at(cls, path: Path) -> bool:
        """Return whether a group of this kind was started in a folder."""
        return os.path.isfile(cls.document_in(path))  # False if the folder may not be entered

    @classmethod
    def folders(cls, runs: Path) -> list[Path]:
        """Return the folders of this kind below a folder of runs, the oldest day first.

        One that was created only in part has no document yet (`is_at`).
        """
        return [path for day in folders_in(runs) for path in folders_in(day / cls.kind)]

    @classmethod
    def unreadable(cls, runs: Path) -> list[tuple[Path, str]]:
        """Return the folders of this kind that may not be entered, with what the system says."""
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
        """Return where the document of the group in a folder is."""
        return path / f"{cls.kind}.json"

    @classmethod
    def page_in(cls, path: Path) -> Path:
        """Return where the page of the group in a folder is; it need not have been made."""
        return path / f"{cls.kind}.html"

    def members(self) -> list[Member]:
        """Return the runs of the group, as the document has them now.

        Raises:
            DataError: The document is damaged.
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
            RecordingError: The disk refuses.
        """
        entries = []
        for entry in (member.to_dict() for member in members):
            paths = {key: entry[key] for key in _PATHS if entry.get(key)}
            seen = {key: os.path.relpath(path, self.path) for key, path in paths.items()}
            entries.append(entry | seen)
        document = {**self.head, self.entries: entries}
        write_replacing(self.document_in(self.path), json_document(document))

    def held(self) -> AbstractContextManager[None]:
        """Hold the group while inside; the kernel lets it go when this process dies.

        Raises:
            DataError: Another process works on it.
            RecordingError: The folder cannot be locked.
        """
        return hold_folder(
            self.path,
            lambda holder: DataError(
                f"{self.path} belongs to {holder}", hint="wait until that has ended"
            ),
        )

    @classmethod
    def _version_key(cls) -> str:
        return f"hil_{cls.kind}_run"

    @classmethod
    def _read(cls, path: Path) -> Document:
        """Return the document, with entries that have what every entry needs."""
        file = cls.document_in(path)
        document = read_json(file)
        require_known_version(file, document, cls._version_key(), GROUP_FORMAT)
        entries = document.setdefault(cls.entries, [])
        if not isinstance(entries, list) or not all(
            isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in cls.required)
            for entry in entries
        ):
            raise DataError(
                f"{file}: `{cls.entries}` is no list of {cls.described}",
                hint="it is damaged or was edited: take it from a copy",
            )
        return document


class SeriesGroup(RunGroup):
    """The folder of a series: experiments that are run one after the other."""

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
        """Make the folder of a series that starts now.

        Args:
            runs: Where run directories are kept.
            name: Of the series.
            source: Its file, to go on with it later.
            description: What it is for.
            station: Named in place of those in the files.
            commissioning: What of each experiment is executed, and how fast; None for all of it.

        Raises:
            RecordingError: It cannot be written.
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
    """The folder of a fleet: an experiment that many robots run, some at a time."""

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
        """Make the folder of a fleet that starts now, with the spec of every robot.

        Args:
            runs: Where run directories are kept.
            name: Of the experiment.
            specs: Text of the spec by robot.
            source: The spec's file.
            station: The station's file; empty for the one an experiment beside `source` would use.
            robots: File that names real robots with their addresses; None for mocks.

        Raises:
            RecordingError: It cannot be written.
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
        """See `RunGroup.open`; the path is made absolute, as runs name their spec by such a one."""
        return super().open(path.resolve())

    @property
    def runs(self) -> Path:
        """The folder of runs that the fleet lies in."""
        return self.path.parents[2]

    @property
    def models(self) -> Path:
        """Where models are stored that are fitted to the robots' runs."""
        return self.path / "models"

    def spec_of(self, robot: str) -> Path:
        """Return the spec as one robot runs it."""
        return self.path / "specs" / f"{robot}.yaml"

    def run_of(self, robot: str) -> Path | None:
        """Return the newest run of a robot for this fleet, by what the runs themselves say."""
        mine = self.spec_of(robot).parts[-5:]  # runs may have been moved together since
        runs = [
            run
            for run in run_folders(self.runs)
            if run.parent.name == name_for_path(robot) and _spec_named_by(run).parts[-5:] == mine
        ]
        return max(runs, key=lambda run: run.name, default=None)

    @staticmethod
    def place_named_by(run: Path) -> tuple[str, ...]:
        """Return `DAY, fleet, fleet-NAME`, where the spec that a run names lies in such a place."""
        return _spec_named_by(run).parts[-5:-2]

    def completed(self) -> list[Path]:
        """Return the runs that have measured all they should."""
        return [
            member.run
            for member in self.members()
            if member.run is not None and member.report.get("outcome") == "completed"
        ]


def _spec_named_by(run: Path) -> Path:
    """Return the spec in a run's start document; an empty path if that is damaged."""
    try:
        return Path(str(read_json(run / "start.json").get("spec", "")))
    except DataError:
        return Path()
