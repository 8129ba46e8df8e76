"""Starting a run: choose, check and plan, start, and what became of it before it had a page."""

from __future__ import annotations

import secrets
import unicodedata
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.campaign.starting import Started, check_start, start_run, started_runs
from hil.errors import DataError, HilError, SpecError
from hil.plan.commissioning import commissioning_of
from hil.web.given_files import require_files_offered
from hil.web.going import words_of
from hil.web.offered import file_offered, offered
from hil.web.once import Once
from hil.web.places import address_of
from hil.web.plan_shown import PICTURES, shown_plan
from hil.web.rendering import page, settings_of, who_of
from hil.web.security import form_of
from hil.web.settings import Settings
from hil.web.threads import PLANS, in_thread

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
    given = await form_of(request)
    if given.get("do") == "start":
        return await run_in_threadpool(_begin, request, given)
    if not PLANS.acquire(blocking=False):
        busy = HilError("two plans are being made at the moment", hint="try again in a moment")
        return await run_in_threadpool(_form, request, given, error=busy, status=503)
    try:
        return await run_in_threadpool(_begin, request, given)
    finally:
        PLANS.release()


def started_page(request: Request) -> Response:
    """What became of a run that was started; leads to its page once it has one."""
    settings = settings_of(request)
    started = _started(request.path_params["id"], settings)
    if made := started.made:
        return RedirectResponse(address_of(made[-1], settings), 303)
    answer = page(
        request,
        "started.html.j2",
        title="Starting" if started.alive else "Not started",
        started=_told(started, settings),
        last_words=started.last_words,
    )
    if started.alive:
        answer.headers["Refresh"] = "1"
    return answer


async def cancel(request: Request) -> Response:
    """End a started run that has no page yet."""
    await form_of(request)
    name, settings = request.path_params["id"], settings_of(request)
    await in_thread("asking", lambda: _started(name, settings).cancel(who_of(request)))
    return RedirectResponse(f"/start/{name}", 303)


def _begin(request: Request, given: Mapping[str, str]) -> Response:
    settings = settings_of(request)
    try:
        spec = file_offered(given.get("spec", ""), settings, "experiment", "series")
        named = given.get("station", "")
        station = file_offered(named, settings, "station") if named else None
        overrides = overrides_in(given.get("overrides", ""))
        require_files_offered(overrides, spec, settings)
        who = given.get("operator", "").strip()[:80] or who_of(request)
        require_text(who, "the name of who is at the robot")
        speed, first = given.get("speed", "").strip(), given.get("first", "").strip()
        part = commissioning_of(speed, first)
        if given.get("do") == "start":
            start = partial(
                start_run, spec, settings.runs, station=station, operator=who,
                overrides=overrides, speed=speed, first=first,
            )  # fmt: skip
            started = _once(given, settings, lambda: start().id)
            return RedirectResponse(f"/start/{started}", 303)
        plans = [shown_plan(each, part) for each in check_start(spec, station, overrides)]
        for each in plans[PICTURES:]:
            each["picture"] = ""
    except HilError as error:
        return _form(request, given, error=error, status=422)
    return _form(request, given, plans=plans)


def overrides_in(text: str) -> dict[str, str]:
    """Lines `path=value`; empty ones say nothing.

    Raises:
        SpecError: A line says something else, or cannot be a text.
    """
    require_text(text, "what is laid over the spec", but="\r\n\t")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    pairs = [line.partition("=") for line in lines]
    for line, (path, equals, _) in zip(lines, pairs, strict=True):
        if not (equals and path.strip()):
            raise SpecError(f"{line!r} changes nothing", hint="a line is: excitation.waypoints=20")
    return {path.strip(): value.strip() for path, _, value in pairs}


def require_text(text: str, what: str, *, but: str = "") -> None:
    """Refuse control characters: no command line takes a NUL, and no name or value needs one.

    Args:
        text: What was typed, or sent by a program.
        what: What it is, for the message.
        but: Control characters it may have.

    Raises:
        SpecError: It has others.
    """
    found = sorted({c for c in text if unicodedata.category(c) == "Cc" and c not in but})
    if found:
        listed = ", ".join(f"U+{ord(c):04X}" for c in found)
        raise SpecError(f"{what} has control characters ({listed})", hint="type it anew")


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
        given={key: given.get(key, "") for key in FIELDS},
        speeds=SPEEDS,
        error=error,
        once=secrets.token_urlsafe(12),
        plans=plans or [],
        started=[_told(one, settings) for one in started_runs(settings.runs)[:SHOWN]],
    )


def _told(started: Started, settings: Settings) -> dict[str, Any]:
    made = started.made
    again = started.again is not None
    unmade = words_of(started) if started.alive else "did not go on" if again else "did not begin"
    return {
        "id": started.id,
        "spec": Path(started.spec).name,
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
