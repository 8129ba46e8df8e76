"""Runs that say something only together: those of a series, and those of a fleet."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hil.core import DataError, read_json
from hil.recording import folders_in
from hil.runs.series_folder import SeriesFolder, is_series_folder


def groups(runs: Path, paths: Iterable[Path]) -> list[tuple[str, set[Path]]]:
    """Name and runs (resolved) of every series and fleet.

    Args:
        runs: The folder of runs.
        paths: The run directories in it.

    Raises:
        DataError: The document of a series cannot be read.
    """
    return [*_series(runs), *_fleets(runs, paths)]


def start_of(run: Path) -> Mapping[str, Any]:
    """What a run says of its beginning; nothing if it is damaged."""
    try:
        return read_json(run / "start.json")
    except DataError:
        return {}


def _series(runs: Path) -> list[tuple[str, set[Path]]]:
    found = []
    folders = [path for day in folders_in(runs) for path in folders_in(day / "series")]
    for path in filter(is_series_folder, folders):
        try:
            folder, members = SeriesFolder.open(path)
        except DataError as error:
            hint = "nothing is deleted before; its folder is a view and may be moved away"
            raise DataError(error.message, hint=hint) from error
        paths = {Path(one["run"]).resolve() for one in members if isinstance(one.get("run"), str)}
        found.append((folder.path.name, paths))
    return found


def _fleets(runs: Path, paths: Iterable[Path]) -> list[tuple[str, set[Path]]]:
    """By the specs that runs name: `fleet.json` is behind them after a kill."""
    known = {path.parts[-3:] for day in folders_in(runs) for path in folders_in(day / "fleet")}
    found: defaultdict[tuple[str, ...], set[Path]] = defaultdict(set)
    for run in paths if known else ():
        # DAY/fleet/fleet-NAME/specs/ROBOT.yaml; runs may have been moved together since
        fleet = Path(str(start_of(run).get("spec", ""))).parts[-5:-2]
        if fleet in known:
            found[fleet].add(run.resolve())
    return [(name, members) for (*_, name), members in found.items()]
