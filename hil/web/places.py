"""Addresses of runs, and the runs at addresses; nothing outside the folder of runs has one."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from hil.errors import DataError
from hil.record.known_runs import known_runs
from hil.web.settings import Settings


def name_of(run: Path, settings: Settings) -> str:
    """A run below the folder of runs, such as `2026-11-22/ur5/0042-dwell`."""
    return run.resolve().relative_to(settings.runs.resolve()).as_posix()


def address_of(run: Path, settings: Settings) -> str:
    """Path of the page of a run."""
    return f"/runs/{quote(name_of(run, settings))}"


def run_at(name: str, settings: Settings) -> Path:
    """The run directory of an address.

    Raises:
        DataError: There is none, or it is outside the folder of runs.
    """
    root = settings.runs.resolve()
    path = _there(root / name)
    if path is None or not path.is_relative_to(root) or path == root:
        raise DataError(f"there is no run {name} in {settings.runs}", hint="look at /runs")
    return path


def live_runs(settings: Settings, within_s: float = 0.0) -> list[Path]:
    """The runs that processes hold at the moment.

    Args:
        settings: What is served.
        within_s: See `hil.record.known_runs.KnownRuns.live`.
    """
    root = settings.runs.resolve()
    live = known_runs(settings.runs).live(within_s)
    return [run for run in live if run.resolve().is_relative_to(root)]


def _there(path: Path) -> Path | None:
    """A folder that is there, links followed; names may be such as no folder can have."""
    try:
        found = path.resolve()
        return found if found.is_dir() else None
    except (OSError, ValueError):  # too long; with a NUL
        return None
