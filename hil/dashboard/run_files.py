"""Files of runs: its pages, shut in so that they cannot act as the dashboard, and downloads.

A run may have come from elsewhere. Its pages are served at addresses like those on the disk, so
that links between them lead where they should.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from hil.core import DataError, name_read, name_text, quoted
from hil.dashboard.places import address_of, run_at
from hil.dashboard.rendering import settings_of
from hil.dashboard.settings import Settings
from hil.recording import number_of
from hil.report import REPORT_FILE, size

SHUT_IN = {
    "Content-Security-Policy": "sandbox allow-scripts allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:",
    # Browsers show nothing at all that is both shut in and has a group of windows of its own.
    "Cross-Origin-Opener-Policy": "unsafe-none",
}
"""Of pages that are not ours: their scripts run, in an origin of nobody's."""

FOLDERS = ("recording", "fit", "study")
MOST_LISTED = 300
DEEP = 3
"""Folders of a run below that of all: day, robot, run."""


def report_of(request: Request) -> Response:
    """The report of a run."""
    run = require_run(request.path_params["name"], settings_of(request))
    hint = f"make it with: hil report {run.name}"
    return shut_in(_inside(run, REPORT_FILE, hint))


def page_of(request: Request) -> Response:
    """Any page below the folder of runs: of a run, a fleet, a series or a simulation."""
    settings, (folder, _, name) = settings_of(request), request.path_params["page"].rpartition("/")
    return shut_in(_inside(run_at(folder, settings), f"{name}.html", "look at /runs"))


def file_of(request: Request) -> Response:
    """A file of a run, to be kept."""
    run = require_run(request.path_params["name"], settings_of(request))
    named = request.query_params.get("path", "")
    path = run / name_read(named)
    if path not in files_in(run):
        raise DataError(f"{run.name} has no file {named!r}", hint="its page lists those it has")
    return FileResponse(path, media_type="application/octet-stream", filename=name_text(path.name))


def require_run(name: str, settings: Settings) -> Path:
    """The run directory of an address, damaged or not.

    Raises:
        DataError: There is none.
    """
    run = run_at(name, settings)
    # A day has a number, too, but is not where runs are.
    in_place = number_of(run) and len(run.relative_to(settings.runs.resolve()).parts) == DEEP
    if not in_place and not (run / "start.json").is_file():
        raise DataError(f"there is no run {name} in {settings.runs}", hint="look at /runs")
    return run


def report_address(run: Path, settings: Settings) -> str:
    """Where the report of a run is served; empty where there is none."""
    there = (run / REPORT_FILE).is_file()
    return f"{address_of(run, settings)}/report" if there else ""


def shut_in(path: Path) -> Response:
    """A page of somebody else, unable to do what ours can."""
    return FileResponse(path, media_type="text/html; charset=utf-8", headers=SHUT_IN)


def files_in(run: Path) -> list[Path]:
    """Files that belong to a run, by name; neither links nor what is hidden."""
    found = _plain_files(run)
    for name in FOLDERS:
        found += _plain_files(run / name)
        for folder in _folders(run / name):
            found += _plain_files(folder)
    # A folder of the run, too, may be a link: to all that the dashboard's user may read.
    return [path for path in found if _is_below(path, run)]


def listed_files(run: Path, settings: Settings) -> list[dict[str, Any]]:
    """`name`, `size` in words, and `address` of a run's files, the first of them."""
    where = address_of(run, settings)
    found = []
    for path in files_in(run)[:MOST_LISTED]:
        name = name_text(path.relative_to(run))
        address = f"{where}/file?path={quoted(name)}"
        found.append({"name": name, "size": _size(path), "address": address})
    return found


def _inside(folder: Path, name: str, hint: str) -> Path:
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise DataError(f"{folder.name} has no {name}", hint=hint)
    return path


def _is_below(path: Path, run: Path) -> bool:
    try:
        return path.resolve(strict=True).is_relative_to(run.resolve())
    except (OSError, RuntimeError):  # gone meanwhile; links in a ring
        return False


def _plain_files(folder: Path) -> list[Path]:
    return sorted(Path(entry) for entry in _entries(folder) if entry.is_file(follow_symlinks=False))


def _folders(folder: Path) -> list[Path]:
    return sorted(Path(entry) for entry in _entries(folder) if entry.is_dir(follow_symlinks=False))


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            yield from (entry for entry in entries if not entry.name.startswith("."))
    except OSError:
        return


def _size(path: Path) -> str:
    try:
        return size(path.stat().st_size)
    except OSError:
        return ""


routes = [
    Route("/runs/{name:place}/report", report_of),
    Route("/runs/{name:place}/file", file_of),
    Route("/runs/{page:place}.html", page_of),
]
