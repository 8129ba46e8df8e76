"""Schedules: what is due, what became of everything that was, and holding them."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import DataError, SpecError, did_you_mean
from hil.dashboard.rendering import page, settings_of, who_of
from hil.dashboard.schedule_facts import (
    blackouts_of,
    commands_for,
    expected_of,
    facts_of_schedule,
    foreseen,
    open_of,
    row_of,
    told_of,
)
from hil.dashboard.schedules_known import Known, known_schedules
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings
from hil.maintenance import Ledger, Line, hold, release

PER_PAGE = 50

TOLD = ("started", "done", "failed", "missed", "held", "released")
_REASON = 500


def schedules(request: Request) -> Response:
    """All schedules, and what is due next."""
    settings = settings_of(request)
    rows = [row_of(one) for one in known_schedules(settings)]
    return page(request, "schedules.html.j2", title="Schedules", schedules=rows)


def schedule(request: Request) -> Response:
    """One schedule."""
    settings = settings_of(request)
    one = _named(request.path_params["name"], settings)
    told = [line for line in one.ledger.lines if line["event"] in TOLD] if one.ledger else []
    pages = max(1, math.ceil(len(told) / PER_PAGE))
    asked = request.query_params.get("page", "1")
    at = min(max(int(asked) if asked.isdecimal() and len(asked) < 9 else 1, 1), pages)
    shown = told[::-1][(at - 1) * PER_PAGE : at * PER_PAGE]
    expected, unforeseen = expected_of(one)
    return page(
        request, "schedule.html.j2", title=one.name, one=row_of(one), problems=one.problems,
        held=one.held, by_hand=bool(one.ledger and one.ledger.standing.held),
        facts=facts_of_schedule(one), blackouts=blackouts_of(one.spec),
        expected=[foreseen(each, one) for each in expected], unforeseen=unforeseen,
        open=open_of(one), lines=[told_of(line, one, settings) for line in shown], count=len(told),
        at=at, pages=pages, address=one.address, commands=commands_for(one, settings),
    )  # fmt: skip


async def hold_it(request: Request) -> Response:
    """Let nothing begin until it is released."""
    return await _say(request, hold)


async def release_it(request: Request) -> Response:
    """Let it go on."""
    return await _say(request, release)


async def _say(request: Request, say: Callable[[Ledger, datetime, str, str], Line]) -> Response:
    reason = " ".join((await form_of(request)).get("reason", "").split())[:_REASON]
    if not reason:
        raise SpecError("a reason is wanted", hint="it is kept in the ledger; go back and give one")
    return await run_in_threadpool(_said, request, say, reason)


def _said(
    request: Request, say: Callable[[Ledger, datetime, str, str], Line], reason: str
) -> Response:
    one = _named(request.path_params["name"], settings_of(request))
    if one.ledger is None:
        raise DataError(one.problems[0])
    if not one.ledger.lines:
        raise DataError(f"{one.name} has never been started", hint="hil schedule run FILE")
    say(one.ledger, datetime.now(UTC), reason, who_of(request))
    return RedirectResponse(one.address, 303)


def _named(name: str, settings: Settings) -> Known:
    known = {one.name: one for one in known_schedules(settings)}
    if name not in known:
        hint = did_you_mean(name, known) or "look at /schedules"
        raise DataError(f"there is no schedule {name}", hint=hint)
    return known[name]


routes = [
    Route("/schedules", schedules),
    Route("/schedules/{name}", schedule),
    Route("/schedules/{name}/hold", hold_it, methods=["POST"]),
    Route("/schedules/{name}/release", release_it, methods=["POST"]),
]
