"""Where a fleet is kept, beside the robots of the day: `DAY/fleet/fleet-NAME`.

`specs/ROBOT.yaml` is the spec as each robot runs it, written before anything moves. Every run names
its spec in `start.json`, and so the fleet and the robot it is of, however this process ends.
`fleet.json` says which run is whose and is a view: it is replaced when there is more to tell.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    hold_folder,
    json_document,
    new_folder,
    read_json,
    require_known_version,
    write_once,
    write_replacing,
)
from hil.recording import name_for_path, run_folders

DOCUMENT, PAGE, SPECS, MODELS = "fleet.json", "fleet.html", "specs", "models"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class FleetFolder:
    """The folder of one fleet that was begun.

    Attributes:
        path: The folder, absolute.
        head: What its document says besides the members.
    """

    path: Path
    head: Mapping[str, Any]

    @classmethod
    def create(
        cls,
        runs: Path,
        name: str,
        specs: Mapping[str, str],
        source: Path,
        station: str,
        robots: Path | None = None,
    ) -> FleetFolder:
        """Make the folder of a fleet that begins now.

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
        now = datetime.now().astimezone()
        above = runs.resolve() / now.date().isoformat() / "fleet"
        head = {
            "hil_fleet_run": FORMAT,
            "name": name,
            "source": str(source.resolve()),
            "station": station and str(Path(station).resolve()),
            "started": now.isoformat(timespec="seconds"),
            **({"robots": str(robots.resolve())} if robots else {}),
        }
        made = cls(new_folder(above, f"fleet-{name_for_path(name)}"), head)
        (made.path / SPECS).mkdir()
        for robot, text in specs.items():
            write_once(made.spec_of(robot), text.encode())
        made.write([{"robot": robot} for robot in specs])
        return made

    @classmethod
    def open(cls, path: Path) -> tuple[FleetFolder, list[dict[str, Any]]]:
        """The folder of a fleet, and the entries of its document.

        Raises:
            DataError: It has no document, a damaged one, or one of a newer hil.
        """
        document = read_json(path / DOCUMENT)
        require_known_version(path / DOCUMENT, document, "hil_fleet_run", FORMAT)
        members = document.pop("members", [])
        if not isinstance(members, list) or not all(
            isinstance(one, dict) and isinstance(one.get("robot"), str) for one in members
        ):
            raise DataError(
                f"{path / DOCUMENT}: `members` is no list of robots and their runs",
                hint="it is damaged or was edited: take it from a copy",
            )
        for one in members:
            paths = {key: one[key] for key in ("run", "report") if isinstance(one.get(key), str)}
            one.update({key: os.path.normpath(path / told) for key, told in paths.items()})
        return cls(path.resolve(), document), members

    @property
    def runs(self) -> Path:
        """Where the run directories are."""
        return self.path.parents[2]

    def spec_of(self, robot: str) -> Path:
        """The spec as one robot runs it."""
        return self.path / SPECS / f"{robot}.yaml"

    def run_of(self, robot: str) -> Path | None:
        """The newest run of a robot for this fleet, by what the runs themselves say."""
        mine = self.spec_of(robot).parts[-5:]  # runs may have been moved together since
        found = [
            run
            for run in run_folders(self.runs)
            if run.parent.name == name_for_path(robot)
            and _spec_named_in(run / "start.json").parts[-5:] == mine
        ]
        return max(found, key=lambda run: run.name, default=None)

    def write(self, members: Sequence[Mapping[str, Any]]) -> None:
        """Replace the document; paths are written as seen from here."""
        told = [{**one, **self._seen_from_here(one)} for one in members]
        write_replacing(self.path / DOCUMENT, json_document({**self.head, "members": told}))

    def _seen_from_here(self, member: Mapping[str, Any]) -> dict[str, str]:
        paths = {key: member[key] for key in ("run", "report") if member.get(key)}
        return {key: os.path.relpath(path, self.path) for key, path in paths.items()}

    def held(self) -> AbstractContextManager[None]:
        """Alone at work on this fleet while inside; freed by this process's death.

        Raises:
            DataError: Another process is at it.
            RecordingError: The folder cannot be locked.
        """
        return hold_folder(
            self.path,
            lambda holder: DataError(
                f"{self.path} belongs to {holder}", hint="wait until that has ended"
            ),
        )


def completed(members: Sequence[dict[str, Any]]) -> list[Path]:
    """Runs of a fleet's document that have measured all they should."""
    return [Path(one["run"]) for one in members if one.get("outcome") == "completed"]


def is_fleet_folder(path: Path) -> bool:
    """Whether a fleet was begun in a folder."""
    return (path / DOCUMENT).is_file()


def _spec_named_in(start: Path) -> Path:
    try:
        return Path(str(read_json(start).get("spec", "")))
    except DataError:  # a run that is damaged belongs to nobody
        return Path()
