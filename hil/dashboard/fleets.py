"""Pages of fleets: one experiment on many robots of a station, with one row per robot.

The state of a robot is read from its run. If this dashboard does not have the run of a robot, the
state is read from the document of the fleet.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import DataError, HilError, holder_of, shell_word
from hil.dashboard.catalogue import status_mark, verdict_mark
from hil.dashboard.rendering import page
from hil.dashboard.run_files import folder_at, report_address, run_address, run_name, run_named
from hil.dashboard.settings import Settings, settings_of
from hil.recording import FleetGroup, Member, unreadable_folders
from hil.report import counted, when
from hil.runs import listing_of

MOST_LISTED = 200


def fleets(request: Request) -> Response:
    """Show the list of all fleets, newest first."""
    settings = settings_of(request)
    closed = unreadable_folders(settings.runs) + FleetGroup.unreadable(settings.runs)
    problems = [f"{folder}: {why}; fleets in it are not listed" for folder, why in closed]
    folders = [one for one in reversed(FleetGroup.folders(settings.runs)) if FleetGroup.is_at(one)]
    rows = [_row(path, settings, problems) for path in folders[:MOST_LISTED]]
    return page(
        request, "fleets.html.j2", title="Fleets", problems=problems,
        fleets=[row for row in rows if row], left_out=max(0, len(folders) - MOST_LISTED),
    )  # fmt: skip


def _row(path: Path, settings: Settings, problems: list[str]) -> dict[str, Any] | None:
    try:
        group = FleetGroup.open(path)
        members = group.members()
        address = f"/fleets{run_address(path, settings).removeprefix('/runs')}"
    except HilError as error:
        problems.append(error.message)
        return None
    except ValueError:  # a link to a folder outside of the folder of runs
        return None
    return {
        "name": str(group.head.get("name") or path.name),
        "folder": run_name(path, settings),
        "address": address,
        "page": _page_address(path, settings),
        "started": when(group.head.get("started")),
        "robots": len(members),
        "told": _summary([_documented(one) for one in members]),
        "live": holder_of(path / ".lock") is not None,
    }


def _page_address(path: Path, settings: Settings) -> str:
    """Return the path of the report page of a fleet; empty if the fleet has no report."""
    page = FleetGroup.page_in(path)
    return f"{run_address(path, settings)}/{page.name}" if page.is_file() else ""


def _summary(rows: list[dict[str, Any]]) -> str:
    """Return a summary of a fleet, such as `9 completed, 1 not begun; 8 passed`."""
    ends = Counter(row["status"] for row in rows)
    verdicts = Counter(row["verdict"] for row in rows if row["verdict"])
    parts = (", ".join(f"{n} {word}" for word, n in one.items()) for one in (ends, verdicts))
    return "; ".join(filter(None, parts)) or counted(0, "robot")


def _documented(member: Member) -> dict[str, str]:
    """Return the state of a robot from the fleet document, without opening other files."""
    return {
        "status": str(member.report.get("outcome") or "not begun"),
        "verdict": str(member.report.get("verdict") or ""),
    }


def fleet(request: Request) -> Response:
    """Show the page of one fleet, with one row per robot."""
    settings, name = settings_of(request), request.path_params["name"]
    path = folder_at(name, settings)
    if not FleetGroup.is_at(path):
        raise DataError(f"there is no fleet {name} in {settings.runs}", hint="see /fleets")
    group = FleetGroup.open(path)
    held = holder_of(path / ".lock")
    rows = [_member(one, settings) for one in group.members()]
    return page(
        request, "fleet.html.j2", title=str(group.head.get("name") or path.name),
        name=run_name(path, settings), started=when(group.head.get("started")),
        source=str(group.head.get("source") or ""), held=str(held) if held else "",
        told=_summary(rows), members=rows, page_address=_page_address(path, settings),
        commands=_commands(path, rows, held is not None, settings),
    )  # fmt: skip


def _member(member: Member, settings: Settings) -> dict[str, Any]:
    """Return the table row of a robot, from its run or otherwise from the document of the fleet."""
    documented, where = _documented(member), str(member.run or "")
    run = run_named(where, settings, str(member.report.get("uid") or ""))
    status = listing_of(run).status if run else documented["status"]
    return {
        "robot": member.robot,
        "run": Path(where).name,
        "address": run_address(run, settings) if run else "",
        "report": report_address(run, settings) if run else "",
        "status": status,
        "status_mark": status_mark(status),
        "verdict": documented["verdict"],
        "verdict_mark": verdict_mark(documented["verdict"]),
        "error": member.error.message if member.error else "",
    }


def _commands(
    path: Path, rows: list[dict[str, Any]], live: bool, settings: Settings
) -> list[tuple[str, str]]:
    where, registry = shell_word(path), f"--registry {shell_word(settings.registry)}"
    found = []
    if not live and any(row["status"] != "completed" for row in rows):
        found.append(
            ("Resume unfinished runs and start missing ones:", f"hil fleet resume {where}")
        )
    fit = f"hil fleet fit {where} --estimator rigid-wls --register {registry}"
    found.append(("Fit a model to each robot and register it:", fit))
    found.append(("Create the page of the fleet:", f"hil fleet report {where} {registry}"))
    return found


routes = [
    Route("/fleets", fleets),
    Route("/fleets/{name:place}", fleet),
]
