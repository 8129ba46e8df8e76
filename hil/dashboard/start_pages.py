"""Starting a run: choose, check and plan, start, and what became of it before it had a page."""

from __future__ import annotations

import secrets
from asyncio import CancelledError
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import DataError, HilError, name_text
from hil.dashboard.going import words_of
from hil.dashboard.held_by import held_by
from hil.dashboard.motions import MOTIONS, plans_to_show, refusal_of
from hil.dashboard.offered import offered
from hil.dashboard.once import Once
from hil.dashboard.places import address_of
from hil.dashboard.planning import Gone
from hil.dashboard.rendering import page, settings_of, who_of
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings
from hil.dashboard.threads import in_thread
from hil.dashboard.wanted import Wanted, wanted_in
from hil.workflow import Started, start_run, started_runs

FIELDS = ("spec", "station", "overrides", "operator", "speed", "first")
"""What a form says, and with that what a run is."""

SPEEDS = ("50%", "25%", "10%", "5%")

SHOWN = 5
"""Of so many runs that were started it is told what became of them."""

ONCE = Once()


def start_page(request: Request) -> Response:
    """The form, empty or with the spec that the address names."""
    return _form(request, {"spec": request.query_params.get("spec", "")})


async def begin(request: Request) -> Response:
    """Check what the form says and show the plan, or start it."""
    given, settings = await form_of(request), settings_of(request)

    async def form(**more: Any) -> Response:
        return await run_in_threadpool(_form, request, given, **more)

    look = partial(wanted_in, given, settings, who_of(request))
    changed: dict[str, Any] = {}
    try:
        if given.get("do") == "start":
            wanted = await run_in_threadpool(look)
            refusal = refusal_of(given, wanted.digest, real=wanted.real)
            if refusal is None:
                started = await in_thread("starting", _start, wanted, given, settings)
                return RedirectResponse(f"/start/{started}", 303)
            changed = {"error": refusal, "status": 409}
        shown = await plans_to_show(
            lambda: run_in_threadpool(lambda: look().asked), request.is_disconnected
        )
    except HilError as error:
        return await form(error=error, status=422)
    except (Gone, CancelledError):  # by whoever asked, or with the dashboard: nobody reads it
        return Response(status_code=499)
    return await form(**changed | shown)


def started_page(request: Request) -> Response:
    """What became of a run that was started; leads to its page once it has one."""
    settings = settings_of(request)
    started = _started(request.path_params["id"], settings)
    if made := started.made:
        return RedirectResponse(address_of(made[-1], settings), 303)
    said = started.last_words
    return page(
        request,
        "started.html.j2",
        title="Starting" if started.alive else "Not started",
        started=_told(started, settings),
        last_words=said,
        held=None if started.alive else held_by(said, settings),
    )


async def cancel(request: Request) -> Response:
    """End a started run that has no page yet."""
    await form_of(request)
    name, settings = request.path_params["id"], settings_of(request)
    await in_thread("asking", lambda: _started(name, settings).cancel(who_of(request)))
    return RedirectResponse(f"/start/{name}", 303)


def _start(wanted: Wanted, given: Mapping[str, str], settings: Settings) -> str:
    start = partial(
        start_run, wanted.spec, settings.runs, station=wanted.station, operator=wanted.operator,
        overrides=wanted.overrides, speed=wanted.speed, first=wanted.first,
        confirmed=MOTIONS.confirmed(given.get("facts", "")) if wanted.real else None,
    )  # fmt: skip
    return _once(given, settings, lambda: start().id)


def _once(given: Mapping[str, str], settings: Settings, start: Callable[[], str]) -> str:
    """The id of what is started; a form that is sent again starts nothing more."""
    # Changed and sent again it is another one: going back keeps what a form had hidden.
    sent = (str(settings.runs), given.get("once", ""), *(given.get(key, "") for key in FIELDS))
    return ONCE.of(sent, start) if given.get("once") else start()


def _form(
    request: Request,
    given: Mapping[str, str],
    *,
    error: HilError | None = None,
    plans: list[dict[str, Any]] | None = None,
    checked: str = "",
    facts: str = "",
    status: int = 200,
) -> Response:
    settings = settings_of(request)
    return page(
        request,
        "start.html.j2",
        title="Start a run",
        status=status,
        specs=offered(settings, "experiment", "series"),
        stations=offered(settings, "station"),
        folder=settings.specs and settings.specs.resolve(),
        given={key: given.get(key, "") for key in FIELDS},
        speeds=SPEEDS,
        error=error,
        once=secrets.token_urlsafe(12),
        plans=plans or [],
        checked=checked,
        facts=facts,
        confirms=MOTIONS.confirmed(facts).get("robot", ""),
        started=[_told(one, settings) for one in started_runs(settings.runs)[:SHOWN]],
    )


def _told(started: Started, settings: Settings) -> dict[str, Any]:
    made = started.made
    again = started.again is not None
    unmade = words_of(started) if started.alive else "did not go on" if again else "did not begin"
    return {
        "id": started.id,
        "spec": name_text(Path(started.spec).name),
        "operator": started.operator,
        "alive": started.alive,
        "text": ("goes on" if again else "has begun") if made else unmade,
        "log": started.log,
        "run": address_of(started.again, settings) if started.again else "",
        "address": address_of(made[-1], settings) if made else f"/start/{started.id}",
    }


def _started(name: str, settings: Settings) -> Started:
    for one in started_runs(settings.runs):
        if one.id == name:
            return one
    raise DataError(f"nothing was started as {name}", hint="see /start")


routes = [
    Route("/start", start_page),
    Route("/start", begin, methods=["POST"]),
    Route("/start/{id}", started_page),
    Route("/start/{id}/cancel", cancel, methods=["POST"]),
]
