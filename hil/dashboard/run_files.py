"""Runs and their files by address: the only module that converts addresses to paths of runs.

Only two functions convert the path in an address to a path on the disk: `folder_at` (any folder
below the folder of runs, after following links) and `require_run` (a run directory). In the
opposite direction, `run_name` and `run_address` raise ValueError for paths outside the folder of
runs.

A run is possibly from a different computer, with pages from an untrusted author. Untrusted pages
are served at addresses that match their paths on the disk, so that links between these pages work.
Untrusted pages are served in a sandbox, so that their scripts cannot act as the dashboard.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starlette.convertors import PathConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from hil.core import DataError, HilError, name_read, name_text, quoted, read_json
from hil.dashboard.settings import Settings, settings_of
from hil.recording import number_of
from hil.report import REPORT_FILE, size


class Place(PathConvertor):
    """Part of an address that identifies a run; names possibly contain line breaks.

    An example is `2026-11-22/ur5/0042-dwell`.
    """

    regex = r"[\s\S]*"


register_url_convertor("place", Place())


def run_name(run: Path, settings: Settings) -> str:
    """Return the path of a run below the folder of runs, such as `2026-11-22/ur5/0042-dwell`.

    The returned path is encoded for a page; `hil.core.text.name_read` returns the name on the disk.

    Raises:
        ValueError: The run is outside the folder of runs, for example because of a link.
    """
    return name_text(_below(run, settings))


def _below(folder: Path, settings: Settings) -> Path:
    return folder.resolve().relative_to(settings.runs.resolve())


def run_address(run: Path, settings: Settings) -> str:
    """Return the path of the dashboard page of a run.

    Raises:
        ValueError: The run is outside the folder of runs (see `run_name`).
    """
    return f"/runs/{quoted(_below(run, settings))}"


def folder_at(name: str, settings: Settings) -> Path:
    """Return the folder with an address, which is below the folder of runs.

    Raises:
        DataError: The folder does not exist, or the folder is outside the folder of runs.
    """
    root = settings.runs.resolve()
    try:
        path = (root / name).resolve()
        there = path.is_dir()
    except (OSError, ValueError):  # invalid name: too long, or with a NUL character
        there = False
    if not there or not path.is_relative_to(root) or path == root:
        raise DataError(f"there is no run {name} in {settings.runs}", hint="see /runs")
    return path


RUN_DEPTH = 3
"""Number of folder levels from the folder of runs to a run: day, robot, run."""


def require_run(name: str, settings: Settings) -> Path:
    """Return the run directory with an address, even if the run is damaged.

    Raises:
        DataError: There is no run with this address.
    """
    run = folder_at(name, settings)
    # The folder of a day has a number, too, but at a different level.
    in_place = number_of(run) and len(run.relative_to(settings.runs.resolve()).parts) == RUN_DEPTH
    if not in_place and not (run / "start.json").is_file():
        raise DataError(f"there is no run {name} in {settings.runs}", hint="see /runs")
    return run


def report_address(run: Path, settings: Settings) -> str:
    """Return the path of the report of a run; empty if the run has no report."""
    there = os.path.isfile(run / REPORT_FILE)  # False if the folder is not accessible
    return f"{run_address(run, settings)}/report" if there else ""


def run_named(folder: str, settings: Settings, uid: str = "") -> Path | None:
    """Return the run that a document names; None if the run is not below the folder of runs.

    The folder of runs was possibly moved; therefore, the end of the path is searched for in the
    folder of runs.

    Args:
        folder: Path of the run at the time the document was written.
        settings: Settings of the dashboard.
        uid: Identity of the run; empty if the document contains no identity.
    """
    root, path = settings.runs.resolve(), Path(folder)
    if not folder:
        return None
    with contextlib.suppress(OSError, ValueError):
        if path.is_dir() and path.resolve().is_relative_to(root):
            return path.resolve()
    if not uid and path.parts[-4:-3] != (root.name,):
        return None
    below = range(1, len(path.parts)) if uid else (len(path.parts) - 3,)
    for first in below:
        with contextlib.suppress(HilError, OSError, ValueError):
            here = root.joinpath(*path.parts[first:])
            found = read_json(here / "start.json").get("uid")
            if found == uid or not uid:
                return here
    return None


def run_link(folder: str, settings: Settings, uid: str = "") -> dict[str, str]:
    """Return `text` and `address` of a run in a document; the address is possibly empty."""
    run = run_named(folder, settings, uid)
    address = ""
    with contextlib.suppress(ValueError):
        address = run_address(run, settings) if run else ""
    return {"text": Path(folder).name, "address": address}


SANDBOX = {
    "Content-Security-Policy": "sandbox allow-scripts allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:",
    # Browsers show no page that is sandboxed and has a separate browsing context group.
    "Cross-Origin-Opener-Policy": "unsafe-none",
}
"""HTTP headers of untrusted pages, whose scripts run in an opaque origin."""

FOLDERS = ("recording", "fit", "study")
MOST_LISTED = 300


def report(request: Request) -> Response:
    """Show the report of a run."""
    run = require_run(request.path_params["name"], settings_of(request))
    return _sandboxed(run, REPORT_FILE, f"create it with: hil report {run.name}")


def html_page(request: Request) -> Response:
    """Show any page below the folder of runs: of a run, a fleet, a series or a simulation."""
    settings, (folder, _, name) = settings_of(request), request.path_params["page"].rpartition("/")
    return _sandboxed(folder_at(folder, settings), f"{name}.html", "see /runs")


def _sandboxed(folder: Path, name: str, hint: str) -> Response:
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise DataError(f"{folder.name} has no {name}", hint=hint)
    return FileResponse(path, media_type="text/html; charset=utf-8", headers=SANDBOX)


def download(request: Request) -> Response:
    """Send a file of a run as an attachment."""
    run = require_run(request.path_params["name"], settings_of(request))
    name = request.query_params.get("path", "")
    path = run / name_read(name)
    if path not in files_in(run):
        raise DataError(
            f"{run.name} has no file {name!r}", hint="the page of the run lists its files"
        )
    return FileResponse(path, media_type="application/octet-stream", filename=name_text(path.name))


def files_in(run: Path) -> list[Path]:
    """Return the files of a run, sorted by name, without links and hidden files."""
    found = _plain_files(run)
    for name in FOLDERS:
        found += _plain_files(run / name)
        for folder in _folders(run / name):
            found += _plain_files(folder)
    # A folder of the run may be a link to other files of the dashboard's user.
    return [path for path in found if _is_below(path, run)]


def _plain_files(folder: Path) -> list[Path]:
    return sorted(Path(entry) for entry in _entries(folder) if entry.is_file(follow_symlinks=False))


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            yield from (entry for entry in entries if not entry.name.startswith("."))
    except OSError:
        return


def _folders(folder: Path) -> list[Path]:
    return sorted(Path(entry) for entry in _entries(folder) if entry.is_dir(follow_symlinks=False))


def _is_below(path: Path, run: Path) -> bool:
    try:
        return path.resolve(strict=True).is_relative_to(run.resolve())
    except (OSError, RuntimeError):  # deleted meanwhile, or circular links
        return False


def listed_files(run: Path, settings: Settings) -> list[dict[str, Any]]:
    """Return `name`, `size` (as text) and `address` of the first `MOST_LISTED` files of a run."""
    where = run_address(run, settings)
    found = []
    for path in files_in(run)[:MOST_LISTED]:
        name = name_text(path.relative_to(run))
        address = f"{where}/file?path={quoted(name)}"
        found.append({"name": name, "size": _size(path), "address": address})
    return found


def _size(path: Path) -> str:
    try:
        return size(path.stat().st_size)
    except OSError:
        return ""


routes = [
    Route("/runs/{name:place}/report", report),
    Route("/runs/{name:place}/file", download),
    Route("/runs/{page:place}.html", html_page),
]
