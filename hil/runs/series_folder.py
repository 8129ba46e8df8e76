"""Where the overview of a series is kept, beside the robots of the day: `DAY/series/NAME`.

`series.json` says which runs belong together, `series.html` shows them. Both are views: everything
they tell is in the run directories, and either is replaced when there is more to tell.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    HilError,
    json_document,
    new_folder,
    read_json,
    require_known_version,
    write_replacing,
)
from hil.planning import Commissioning
from hil.recording import name_for_path
from hil.report import render_series
from hil.spec import SeriesSpec

DOCUMENT, PAGE = "series.json", "series.html"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class SeriesFolder:
    """The folder of one series that was begun.

    Attributes:
        path: The folder.
        head: What its document says besides the runs.
    """

    path: Path
    head: Mapping[str, Any]

    @classmethod
    def create(
        cls,
        runs: Path,
        spec: SeriesSpec,
        source: Path,
        station: Path | None = None,
        part: Commissioning | None = None,
    ) -> SeriesFolder:
        """Make the folder of a series that begins now.

        Args:
            runs: Where run directories are kept.
            spec: The series.
            source: Its file, to go on with it later.
            station: Named in place of those in the files.
            part: What of each experiment is executed, and how fast; None for all of it.
        """
        now = datetime.now().astimezone()
        above = runs / now.date().isoformat() / "series"
        head = {
            "hil_series_run": FORMAT,
            "name": spec.name,
            "description": spec.description,
            "source": str(source.resolve()),
            "station": str(station.resolve()) if station else None,
            "started": now.isoformat(timespec="seconds"),
            **({"commissioning": part.to_dict()} if part else {}),
        }
        return cls(new_folder(above, f"series-{name_for_path(spec.name)}"), head)

    @property
    def commissioning(self) -> Commissioning | None:
        """What of each experiment is executed, and how fast; None for all of it."""
        recorded = self.head.get("commissioning")
        return Commissioning.from_dict(recorded) if recorded else None

    @classmethod
    def open(cls, path: Path) -> tuple[SeriesFolder, list[dict[str, Any]]]:
        """The folder of a series, and the entries of its document.

        Raises:
            DataError: It has no document, a damaged one, or one of a newer hil.
        """
        document = read_json(path / DOCUMENT)
        require_known_version(path / DOCUMENT, document, "hil_series_run", FORMAT)
        runs = document.pop("runs", [])
        if not isinstance(runs, list) or not all(isinstance(run, dict) for run in runs):
            raise DataError(
                f"{path / DOCUMENT}: `runs` is no list of runs",
                hint="it is damaged or was edited: take it from a copy",
            )
        for run in runs:
            paths = {key: run[key] for key in ("run", "report") if isinstance(run.get(key), str)}
            run.update({key: os.path.normpath(path / told) for key, told in paths.items()})
        return cls(path, document), runs

    def write(self, runs: Sequence[Mapping[str, Any]]) -> Path | None:
        """Replace document and overview; None when the latter could not be made.

        Paths are written as seen from this folder: all runs may be moved together.
        """
        moved = [{**run, **self._seen_from_here(run)} for run in runs]
        write_replacing(self.path / DOCUMENT, json_document({**self.head, "runs": moved}))
        try:
            return render_series(self.path)
        except HilError:
            return None

    def _seen_from_here(self, run: Mapping[str, Any]) -> dict[str, str]:
        paths = {key: run[key] for key in ("run", "report") if run.get(key)}
        return {key: os.path.relpath(path, self.path) for key, path in paths.items()}


def is_series_folder(path: Path) -> bool:
    """Whether a series was begun in a folder."""
    return (path / DOCUMENT).is_file()
