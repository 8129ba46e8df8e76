"""Overview page: live runs, newest runs, due occasions of schedules, and stations.

The robots and current leases of each station are shown without opening a driver. The stations shown
are the stations offered for a start, and the default station.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import HilError, Holder, plain, since_words
from hil.dashboard.catalogue import status_mark, verdict_mark
from hil.dashboard.live_runs import live_headers
from hil.dashboard.rendering import page
from hil.dashboard.run_files import run_address, run_name
from hil.dashboard.schedules import due_next
from hil.dashboard.settings import Settings, settings_of
from hil.dashboard.start_page import offered_files
from hil.planning import find_station
from hil.recording import number_of
from hil.report import counted, duration
from hil.robot import held_leases
from hil.runs import entry_of, listing_of, run_paths
from hil.spec import Station

NEWEST = 8
"""Number of newest runs that the overview lists."""

MOST_STATIONS = 12

FEW_ROBOTS = 12
"""Maximum number of robots of a station that are all listed; at a larger station, free robots
are collapsed.
"""


def overview(request: Request) -> Response:
    """Show the overview."""
    settings = settings_of(request)
    runs = sorted(run_paths(settings.runs), key=lambda run: (number_of(run), run), reverse=True)
    return page(
        request,
        "overview.html.j2",
        title="Overview",
        going=live_headers(settings),
        newest=[_run_row(run, settings) for run in runs[:NEWEST]],
        stations=stations_of(settings),
        coming=due_next(settings),
    )


routes = [Route("/", overview)]


def _run_row(run: Path, settings: Settings) -> dict[str, Any]:
    entry = entry_of(listing_of(run))
    try:
        name, address = run_name(run, settings), run_address(run, settings)
    except ValueError:  # a link to a folder outside of the folder of runs
        name, address = run.name, ""
    return {
        "name": name,
        "address": address,
        "status": entry["status"],
        "status_mark": status_mark(str(entry["status"])),
        "verdict": entry["verdict"],
        "verdict_mark": verdict_mark(entry["verdict"]),
        "duration": duration(entry["duration_s"]),
        "problem": entry["problem"],
    }


def stations_of(settings: Settings) -> list[dict[str, Any]]:
    """Return the stations, followed by an entry `elsewhere` for leases that belong to none of them.

    Returns:
        The entry of a station contains `name`, `source`, `problem`, `told` (number of robots, if
        some are collapsed), `robots`, and the collapsed robots as `rest`. The entry of a robot
        contains `name`, `driver`, `model`, `held` and `run`.
    """
    leases = held_leases()
    stations: list[Path | None] = [None]  # None: the default station
    if settings.specs is not None:
        names = offered_files(settings, "station")[:MOST_STATIONS]
        stations += [settings.specs / name for name in names]
    shown = [_station(file, settings, leases) for file in stations]
    known = {id(robot["lease"]) for one in shown for robot in one["robots"]}
    others = [_held(lease, settings) for lease in leases if id(lease) not in known]
    if others:
        shown.append({"name": "elsewhere", "source": "", "problem": "", **_folded(others)})
    return shown


def _station(file: Path | None, settings: Settings, leases: list[Holder]) -> dict[str, Any]:
    try:
        station, _, source = find_station(settings.specs or Path(), file)
    except HilError as error:
        return {"name": str(file), "source": "", "problem": error.message, **_folded([])}
    robots = _folded(list(_robots(station, source, settings, leases)))
    return {"name": station.name, "source": source, "problem": "", **robots}


def _robots(
    station: Station, source: str, settings: Settings, leases: list[Holder]
) -> Iterator[dict[str, Any]]:
    for name, robot in station.robots.items():
        lease = next((one for one in leases if _is_of(one, name, source)), None)
        held = _held(lease, settings) if lease else {"held": "", "run": None, "lease": None}
        yield {**held, "name": name, "driver": robot.driver, "model": robot.model}


def _is_of(lease: Holder, robot: str, source: str) -> bool:
    station = Path(str(lease.content.get("station", "")))
    path = Path(source)
    same = station == path or (station.is_file() and station.resolve() == path.resolve())
    return same and lease.content.get("robot") == robot


def _held(lease: Holder, settings: Settings) -> dict[str, Any]:
    content = lease.content
    holder = (plain(content.get("user", "?")), lease.process, since_words(content, None))
    return {
        "name": plain(content.get("robot", "?")),
        "driver": plain(content.get("driver", "?")),
        "model": "",
        "held": ", ".join(filter(None, holder)),
        "run": _run_link(plain(content.get("run", ""), most=1000), settings),
        "lease": lease,
    }


def _run_link(run: str, settings: Settings) -> dict[str, str] | None:
    if not run:
        return None
    try:
        return {"name": Path(run).name, "address": run_address(Path(run), settings)}
    except ValueError:  # in a different folder of runs, without a page here
        return {"name": run, "address": ""}


def _folded(robots: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the robots that are always shown, and the robots that are collapsed."""
    if len(robots) <= FEW_ROBOTS:
        return {"told": "", "robots": robots, "rest": []}
    held = [one for one in robots if one["held"]]
    free = [one for one in robots if not one["held"]]
    summary = f"{counted(len(robots), 'robot')}, {len(held) or 'none'} held"
    return {"told": summary, "robots": held, "rest": free}
