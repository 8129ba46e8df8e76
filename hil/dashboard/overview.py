"""The first page: what is going on, what came last, what comes next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.dashboard.bench_facts import stations_of
from hil.dashboard.catalogue_pages import status_mark
from hil.dashboard.going import going_on
from hil.dashboard.places import address_of, name_of
from hil.dashboard.rendering import page, settings_of
from hil.dashboard.schedules_known import coming
from hil.dashboard.settings import Settings
from hil.recording import number_of
from hil.report import duration
from hil.runs import entry_of, listing_of, run_paths

NEWEST = 8
VERDICTS = {"passed": "pass", "rejected": "fail"}


def overview(request: Request) -> Response:
    """What is going on."""
    settings = settings_of(request)
    return page(
        request,
        "overview.html.j2",
        title="Overview",
        going=going_on(settings),
        newest=[_run(run, settings) for run in _newest(settings)],
        stations=stations_of(settings),
        coming=coming(settings),
    )


def _newest(settings: Settings) -> list[Path]:
    found = sorted(run_paths(settings.runs), key=lambda run: (number_of(run), run), reverse=True)
    return found[:NEWEST]


def _run(run: Path, settings: Settings) -> dict[str, Any]:
    entry = entry_of(listing_of(run))
    try:
        name, address = name_of(run, settings), address_of(run, settings)
    except ValueError:  # a link that leads out of the folder of runs
        name, address = run.name, ""
    return {
        "name": name,
        "address": address,
        "status": entry["status"],
        "status_mark": status_mark(str(entry["status"])),
        "verdict": entry["verdict"],
        "verdict_mark": VERDICTS.get(entry["verdict"], "quiet"),
        "duration": duration(entry["duration_s"]),
        "problem": entry["problem"],
    }


routes = [Route("/", overview)]
