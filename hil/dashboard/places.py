"""Addresses of runs, and the runs at addresses; nothing outside the folder of runs has one."""

from __future__ import annotations

from pathlib import Path

from starlette.convertors import PathConvertor, register_url_convertor

from hil.core import DataError, name_text, quoted
from hil.dashboard.settings import Settings
from hil.runs import known_runs


class Place(PathConvertor):
    """Part of an address, such as `2026-11-22/ur5/0042-dwell`: names may have line breaks, too."""

    regex = r"[\s\S]*"


register_url_convertor("place", Place())


def name_of(run: Path, settings: Settings) -> str:
    """Return where a run is below the folder of runs, such as `2026-11-22/ur5/0042-dwell`.

    As text that a page can show; `hil.core.text.name_read` gives the name on the disk.

    Raises:
        ValueError: It is elsewhere, such as behind a link.
    """
    return name_text(_below(run, settings))


def address_of(run: Path, settings: Settings) -> str:
    """Path of the page of a run."""
    return f"/runs/{quoted(_below(run, settings))}"


def _below(folder: Path, settings: Settings) -> Path:
    return folder.resolve().relative_to(settings.runs.resolve())


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
        within_s: See `hil.runs.live_runs.KnownRuns.live`.
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
