"""The robots of the stations that are offered, and who holds them; no driver is opened for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hil.core import HilError, Holder, plain, since_words
from hil.dashboard.offered import offered
from hil.dashboard.places import address_of
from hil.dashboard.settings import Settings
from hil.planning import find_station
from hil.report import counted
from hil.robot import held_leases
from hil.spec import Station

MOST = 12
"""Stations that are shown."""

FEW = 12
"""Robots of a station that are all listed; of more, those that are free lie behind a summary."""


def stations_of(settings: Settings) -> list[dict[str, Any]]:
    """`name`, `source`, `problem`, `told` (how many robots, where that is asked) and robots each.

    Those that are always seen are `robots`, the others `rest`: `name`, `driver`, `model`, `held`
    and `run` each. What is held and belongs to no station shown comes last, under `elsewhere`.
    """
    leases = held_leases()
    shown = [_station(source, settings, leases) for source in _sources(settings)]
    known = {id(robot["lease"]) for one in shown for robot in one["robots"]}
    others = [_held(lease, settings) for lease in leases if id(lease) not in known]
    if others:
        shown.append({"name": "elsewhere", "source": "", "problem": "", **_parted(others)})
    return shown


def _parted(robots: list[dict[str, Any]]) -> dict[str, Any]:
    """Robots that are always seen, and the rest."""
    held = [one for one in robots if one["held"]]
    if len(robots) <= FEW:
        return {"told": "", "robots": robots, "rest": []}
    free = [one for one in robots if not one["held"]]
    told = f"{counted(len(robots), 'robot')}, {len(held) or 'none'} held"
    return {"told": told, "robots": held, "rest": free}


def _sources(settings: Settings) -> Iterator[Path | None]:
    """The station that is taken where none is named, then those offered."""
    yield None
    if settings.specs is not None:
        yield from [settings.specs / name for name in offered(settings, "station")[:MOST]]


def _station(file: Path | None, settings: Settings, leases: list[Holder]) -> dict[str, Any]:
    try:
        station, _, source = find_station(settings.specs or Path(), file)
    except HilError as error:
        return {"name": str(file), "source": "", "problem": error.message, **_parted([])}
    robots = _parted(list(_robots(station, source, settings, leases)))
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
    same = station == Path(source) or (station.is_file() and station.resolve() == _whole(source))
    return same and lease.content.get("robot") == robot


def _whole(source: str) -> Path:
    return Path(source).resolve()


def _held(lease: Holder, settings: Settings) -> dict[str, Any]:
    said = lease.content
    who = ", ".join(
        filter(None, (plain(said.get("user", "?")), lease.process, since_words(said, None)))
    )
    return {
        "name": plain(said.get("robot", "?")),
        "driver": plain(said.get("driver", "?")),
        "model": "",
        "held": who,
        "run": _run(plain(said.get("run", ""), most=1000), settings),
        "lease": lease,
    }


def _run(run: str, settings: Settings) -> dict[str, str] | None:
    """Where the run has a page, its address."""
    if not run:
        return None
    try:
        return {"name": Path(run).name, "address": address_of(Path(run), settings)}
    except ValueError:  # it is kept in another folder of runs
        return {"name": run, "address": ""}
