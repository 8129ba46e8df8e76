"""The catalogue: all runs, searched as `hil runs QUERY` searches."""

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
from hil.dashboard.places import address_of
from hil.dashboard.rendering import page, settings_of
from hil.dashboard.run_files import report_address
from hil.dashboard.settings import Settings
from hil.report import ENDINGS, duration, measure, when
from hil.runs import find_runs, started_s

PER_PAGE = 50

Entry = dict[str, Any]

_ORDERS: dict[str, tuple[str, Callable[[Entry], Any]]] = {
    "run": ("run", lambda run: (run["number"], started_s(run) or 0.0)),
    "name": ("experiment", lambda run: run["name"].casefold()),
    "robot": ("robot", lambda run: (run["robot"], run["serial"])),
    "status": ("ended", lambda run: run["status"]),
    "verdict": ("verdict", lambda run: run["verdict"]),
    "duration": ("duration", lambda run: run["duration_s"] or 0.0),
    "rmse": ("RMSE, held out", lambda run: _least(run)[0]),
}
"""What can be sorted by: heading, and what is compared."""

_FIRST_DOWN = ("run", "duration")
_VERDICTS = {"passed": "pass", "rejected": "fail"}

EXAMPLES = (
    ("robot=ur5-*", "robots by name, * for anything"),
    ("status=completed", "completed, stopped, tripped, failed, interrupted, running, damaged"),
    ("verdict=rejected", "passed, rejected, not judged"),
    ("since=7d", "started in the last seven days; also since=2026-11-21 and until="),
    ("rmse<0.1", "error on held-out data of some model, in the data's unit"),
    ("estimator=rigid-*", "with a model of that estimator"),
    ("load>2", "with a load of more than 2 kg; also duration [s], samples, gaps, number"),
    ("serial=… operator=… occasion=…", "by what the run was told"),
    ("shoulder", "a word of experiment, description or operator"),
)


def catalogue(request: Request) -> Response:
    """Runs that meet a query, a page of them."""
    settings, asked = settings_of(request), request.query_params
    query, by = asked.get("q", "").strip(), asked.get("sort", "run")
    by = by if by in _ORDERS else "run"
    down = asked.get("order", "down" if by in _FIRST_DOWN else "up") == "down"
    found, message, hint = _found(query, settings)
    found.sort(key=_ORDERS["run"][1], reverse=True)  # what is alike stays newest first
    found.sort(key=_ORDERS[by][1], reverse=down)
    pages = max(1, math.ceil(len(found) / PER_PAGE))
    at = min(max(_whole(asked.get("page", "1")), 1), pages)
    shown = found[(at - 1) * PER_PAGE : at * PER_PAGE]
    keep = {"q": query, "sort": by, "order": "down" if down else "up"}
    return page(
        request, "catalogue.html.j2", title="Runs", status=422 if message else 200,
        query=query, message=message, hint=hint, examples=EXAMPLES, count=len(found),
        runs=[_row(run, settings) for run in shown], sort=by, down=down,
        columns=[_column(key, title, keep) for key, (title, _) in _ORDERS.items()],
        at=at, pages=pages, first=(at - 1) * PER_PAGE + 1, last=(at - 1) * PER_PAGE + len(shown),
        newer=_address(keep, at - 1) if at > 1 else "",
        older=_address(keep, at + 1) if at < pages else "",
    )  # fmt: skip


def status_mark(status: str) -> str:
    """The badge of how a run ended."""
    return "live" if status == "running" else ENDINGS.get(status, ("", ""))[1] or "quiet"


def _found(query: str, settings: Settings) -> tuple[list[dict[str, Any]], str, str]:
    """Entries, and what is wrong with the query, and how to mend it."""
    try:
        return find_runs(*_terms(query), runs=settings.runs), "", ""
    except (SpecError, DataError) as error:
        return [], error.message, error.hint or ""


def _terms(query: str) -> list[str]:
    """As a shell would part them; with quotes that do not end, at every blank."""
    try:
        return shlex.split(query)
    except ValueError:
        return query.split()


def _row(run: Entry, settings: Settings) -> dict[str, Any]:
    path = Path(run["run"])
    address, report = _addresses(path, settings)
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
        "verdict_mark": _VERDICTS.get(run["verdict"], "quiet"),
        "duration": duration(run["duration_s"]),
        "error": measure(error, unit) if estimator and math.isfinite(error) else "",
        "estimator": estimator,
    }


def _addresses(run: Path, settings: Settings) -> tuple[str, str]:
    """Of its page and its report; none where a link leads out of the folder of runs."""
    try:
        return address_of(run, settings), report_address(run, settings)
    except ValueError:
        return "", ""


def _least(run: Entry) -> tuple[float, str, str]:
    """Smallest error on held-out data, its unit and the estimator; infinite without one."""
    known = [fit for fit in run["fits"] if fit["rmse"] is not None]
    if not known:
        return math.inf, "", ""
    best = min(known, key=lambda fit: fit["rmse"])
    return best["rmse"], best["unit"], best["estimator"]


def _column(key: str, title: str, keep: Mapping[str, str]) -> dict[str, str]:
    """A heading that sorts; a second time the other way round."""
    now = keep["sort"] == key
    turned = {"up": "down", "down": "up"}[keep["order"]] if now else _first(key)
    sorted_so = {"up": "ascending", "down": "descending"}[keep["order"]] if now else ""
    address = "/runs?" + urlencode({"q": keep["q"], "sort": key, "order": turned})
    return {"key": key, "title": title, "address": address, "sorted": sorted_so}


def _first(key: str) -> str:
    return "down" if key in _FIRST_DOWN else "up"


def _address(keep: Mapping[str, str], at: int) -> str:
    return "/runs?" + urlencode({**keep, "page": at})


def _whole(text: str) -> int:
    return int(text) if text.isdecimal() and len(text) < 9 else 1


routes = [Route("/runs", catalogue)]
