"""Catalogue page: all runs, with the search of `hil runs QUERY`, sorted by a column."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import DataError, SpecError
from hil.dashboard.rendering import page
from hil.dashboard.run_files import report_address, run_address
from hil.dashboard.settings import Settings, settings_of
from hil.report import ENDINGS, duration, measure, when
from hil.runs import find_runs, started_s

PER_PAGE = 50

Entry = dict[str, Any]

ORDERS: dict[str, tuple[str, Callable[[Entry], Any]]] = {
    "run": ("run", lambda run: (run["number"], started_s(run) or 0.0)),
    "name": ("experiment", lambda run: run["name"].casefold()),
    "robot": ("robot", lambda run: (run["robot"], run["serial"])),
    "status": ("ended", lambda run: run["status"]),
    "verdict": ("verdict", lambda run: run["verdict"]),
    "duration": ("duration", lambda run: run["duration_s"] or 0.0),
    "rmse": ("RMSE, held out", lambda run: _least(run)[0]),
}
"""Columns by which the catalogue can be sorted: heading and sort key."""

DESCENDING_FIRST = ("run", "duration")

EXAMPLES = (
    ("robot=ur5-*", "robots by name; * matches any text"),
    ("status=completed", "completed, stopped, tripped, failed, interrupted, running, damaged"),
    ("verdict=rejected", "passed, rejected, not judged"),
    ("since=7d", "started in the last seven days; also since=2026-11-21 and until="),
    ("rmse<0.1", "error of a model on held-out data, in the unit of the data"),
    ("estimator=rigid-*", "runs with a model of that estimator"),
    ("load>2", "runs with a load of more than 2 kg; also duration [s], samples, gaps, number"),
    ("serial=… operator=… occasion=…", "serial number, operator and schedule occasion of the run"),
    ("shoulder", "a word in the name, the description or the operator"),
)


def catalogue(request: Request) -> Response:
    """Show one page of the list of runs that match a query."""
    settings, parameters = settings_of(request), request.query_params
    query, by = parameters.get("q", "").strip(), parameters.get("sort", "run")
    by = by if by in ORDERS else "run"
    down = parameters.get("order", _first_order(by)) == "down"
    runs: list[Entry] = []
    message = hint = ""
    try:
        runs = find_runs(*_terms(query), runs=settings.runs)
    except (SpecError, DataError) as error:
        message, hint = error.message, error.hint or ""
    runs.sort(key=ORDERS["run"][1], reverse=True)  # equal runs are sorted by age, newest first
    runs.sort(key=ORDERS[by][1], reverse=down)
    pages = max(1, math.ceil(len(runs) / PER_PAGE))
    asked = parameters.get("page", "1")
    at = min(max(int(asked) if asked.isdecimal() and len(asked) < 9 else 1, 1), pages)
    first = (at - 1) * PER_PAGE
    shown = runs[first : first + PER_PAGE]
    keep = {"q": query, "sort": by, "order": "down" if down else "up"}
    return page(
        request, "catalogue.html.j2", title="Runs", status=422 if message else 200,
        query=query, message=message, hint=hint, examples=EXAMPLES, count=len(runs),
        runs=[_row(run, settings) for run in shown], sort=by, down=down,
        columns=[_column(key, title, keep) for key, (title, _) in ORDERS.items()],
        at=at, pages=pages, first=first + 1, last=first + len(shown),
        newer=_address(keep, at - 1) if at > 1 else "",
        older=_address(keep, at + 1) if at < pages else "",
    )  # fmt: skip


routes = [Route("/runs", catalogue)]


def status_mark(status: str) -> str:
    """Return the badge style for the status of a run."""
    return "live" if status == "running" else ENDINGS.get(status, ("", ""))[1] or "quiet"


def verdict_mark(verdict: str) -> str:
    """Return the badge style for a verdict."""
    return {"passed": "pass", "rejected": "fail"}.get(verdict, "quiet")


def _terms(query: str) -> list[str]:
    """Split a query like a shell, or at every blank if a quotation mark is not closed."""
    try:
        return shlex.split(query)
    except ValueError:
        return query.split()


def _row(run: Entry, settings: Settings) -> dict[str, Any]:
    path = Path(run["run"])
    try:
        address, report = run_address(path, settings), report_address(path, settings)
    except ValueError:  # a link to a folder outside of the folder of runs
        address = report = ""
    error, unit, estimator = _least(run)
    return {
        "name": path.name,
        "address": address,
        "report": report,
        "experiment": run["name"],
        "started": when(run["started"]) or run["date"],
        "robot": run["robot"],
        "serial": run["serial"],
        "status": run["status"],
        "status_mark": status_mark(run["status"]),
        "problem": run["problem"],
        "verdict": run["verdict"],
        "verdict_mark": verdict_mark(run["verdict"]),
        "duration": duration(run["duration_s"]),
        "error": measure(error, unit) if estimator and math.isfinite(error) else "",
        "estimator": estimator,
    }


def _least(run: Entry) -> tuple[float, str, str]:
    """Return the smallest hold-out error, its unit and its estimator; infinite without a fit."""
    known = [fit for fit in run["fits"] if fit["rmse"] is not None]
    if not known:
        return math.inf, "", ""
    best = min(known, key=lambda fit: fit["rmse"])
    return best["rmse"], best["unit"], best["estimator"]


def _column(key: str, title: str, keep: Mapping[str, str]) -> dict[str, str]:
    """Return a column heading that sorts by its column, or reverses the current order."""
    order, turned = "", _first_order(key)
    if keep["sort"] == key:
        order = {"up": "ascending", "down": "descending"}[keep["order"]]
        turned = {"up": "down", "down": "up"}[keep["order"]]
    address = "/runs?" + urlencode({"q": keep["q"], "sort": key, "order": turned})
    return {"key": key, "title": title, "address": address, "sorted": order}


def _first_order(key: str) -> str:
    return "down" if key in DESCENDING_FIRST else "up"


def _address(keep: Mapping[str, str], at: int) -> str:
    return "/runs?" + urlencode({**keep, "page": at})
