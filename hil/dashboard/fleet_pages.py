"""Fleets: many robots of a station, and what came of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import DataError, HilError, holder_of, shell_word
from hil.dashboard.catalogue_pages import status_mark
from hil.dashboard.places import address_of, name_of, run_at
from hil.dashboard.registered import run_named
from hil.dashboard.rendering import page, settings_of
from hil.dashboard.run_files import report_address
from hil.dashboard.settings import Settings
from hil.models import PAGE, FleetFolder, is_fleet_folder
from hil.recording import folders_in
from hil.report import counted, when
from hil.runs import listing_of

MOST_LISTED = 200

_VERDICTS = {"passed": "pass", "rejected": "fail"}


def fleets(request: Request) -> Response:
    """All fleets, newest first."""
    settings, problems = settings_of(request), list[str]()
    found = list(_folders(settings.runs))
    rows = [_row(path, settings, problems) for path in found[:MOST_LISTED]]
    return page(
        request, "fleets.html.j2", title="Fleets", problems=problems,
        fleets=[row for row in rows if row], left_out=max(0, len(found) - MOST_LISTED),
    )  # fmt: skip


def fleet(request: Request) -> Response:
    """One fleet, robot by robot."""
    settings, name = settings_of(request), request.path_params["name"]
    path = run_at(name, settings)
    if not is_fleet_folder(path):
        raise DataError(f"there is no fleet {name} in {settings.runs}", hint="look at /fleets")
    opened, members = FleetFolder.open(path)
    held = holder_of(path / ".lock")
    rows = [_member(one, settings) for one in members]
    return page(
        request, "fleet.html.j2", title=str(opened.head.get("name") or path.name),
        name=name_of(path, settings), started=when(opened.head.get("started")),
        source=str(opened.head.get("source") or ""), held=str(held) if held else "",
        told=_told(rows), members=rows, page_address=_page_address(path, settings),
        commands=_commands(path, rows, held is not None, settings),
    )  # fmt: skip


def _folders(runs: Path) -> Iterator[Path]:
    """Folders of fleets, the newest day first."""
    for day in reversed(folders_in(runs)):
        yield from (one for one in reversed(folders_in(day / "fleet")) if is_fleet_folder(one))


def _row(path: Path, settings: Settings, problems: list[str]) -> dict[str, Any] | None:
    try:
        opened, members = FleetFolder.open(path)
        address = f"/fleets{address_of(path, settings).removeprefix('/runs')}"
    except HilError as error:
        problems.append(error.message)
        return None
    except ValueError:  # a link that leads out of the folder of runs
        return None
    return {
        "name": str(opened.head.get("name") or path.name),
        "folder": name_of(path, settings),
        "address": address,
        "page": _page_address(path, settings),
        "started": when(opened.head.get("started")),
        "robots": len(members),
        "told": _told([_claimed(one) for one in members]),
        "live": holder_of(path / ".lock") is not None,
    }


def _claimed(member: Mapping[str, Any]) -> dict[str, str]:
    """What the fleet's document says of a robot; nothing else is opened."""
    return {
        "status": str(member.get("outcome") or "not begun"),
        "verdict": str(member.get("verdict") or ""),
    }


def _told(rows: list[dict[str, Any]]) -> str:
    """`9 completed, 1 not begun; 8 passed`."""
    ends = Counter(row["status"] for row in rows)
    verdicts = Counter(row["verdict"] for row in rows if row["verdict"])
    said = (", ".join(f"{n} {word}" for word, n in one.items()) for one in (ends, verdicts))
    return "; ".join(filter(None, said)) or counted(0, "robot")


def _member(told: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    """A robot as its run says now, else as the fleet's document says."""
    claimed = _claimed(told)
    run = run_named(str(told.get("run") or ""), settings, str(told.get("uid") or ""))
    status = listing_of(run).status if run else claimed["status"]
    return {
        "robot": str(told["robot"]),
        "run": Path(str(told.get("run") or "")).name,
        "address": address_of(run, settings) if run else "",
        "report": report_address(run, settings) if run else "",
        "status": status,
        "status_mark": status_mark(status),
        "verdict": claimed["verdict"],
        "verdict_mark": _VERDICTS.get(claimed["verdict"], "quiet"),
        "error": _error(told.get("error")),
    }


def _error(told: Any) -> str:
    return str(told.get("message") or "") if isinstance(told, dict) else ""


def _page_address(path: Path, settings: Settings) -> str:
    """Of its own page; empty where none was made."""
    return f"{address_of(path, settings)}/{PAGE}" if (path / PAGE).is_file() else ""


def _commands(
    path: Path, rows: list[dict[str, Any]], live: bool, settings: Settings
) -> list[tuple[str, str]]:
    where, registry = shell_word(path), f"--registry {shell_word(settings.registry)}"
    found = []
    if not live and any(row["status"] != "completed" for row in rows):
        found.append(("Go on with what ended early or was not begun:", f"hil fleet resume {where}"))
    fit = f"hil fleet fit {where} --estimator rigid-wls --register {registry}"
    found.append(("Fit a model to every robot, and register them:", fit))
    found.append(("Make its page:", f"hil fleet report {where} {registry}"))
    return found


routes = [
    Route("/fleets", fleets),
    Route("/fleets/{name:place}", fleet),
]
