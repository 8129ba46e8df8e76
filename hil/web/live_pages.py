"""The page of a run, its live part, and what is asked of it: stop, pause, resume, answer."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from sse_starlette import EventSourceResponse
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from hil.campaign.live_state import read_live
from hil.campaign.steering import (
    Reaction,
    answer_run,
    pause_run,
    resume_live_run,
    stop_run,
)
from hil.errors import DataError
from hil.record.lock import is_live
from hil.web.live_facts import FIRST_LINES, LiveRun, header_of
from hil.web.places import address_of, live_runs, name_of, run_at
from hil.web.rendering import page, settings_of, who_of
from hil.web.run_facts import facts_of_run
from hil.web.run_files import require_run
from hil.web.security import form_of
from hil.web.settings import Settings

LOOK_EVERY_S = 0.25
LISTENS_WITHIN_S = 3.0
"""A run that has just begun hears nothing for a moment."""


def run_page(request: Request) -> Response:
    """A run: as it goes on, or what came of it."""
    settings = settings_of(request)
    run = require_run(request.path_params["name"], settings)
    if not is_live(run):
        facts = facts_of_run(run, settings)
        return page(request, "run.html.j2", title=name_of(run, settings), facts=facts)
    now = LiveRun(run, settings).look()
    now["log"] = now["log"][-FIRST_LINES:]
    return page(request, "live_run.html.j2", title=now["name"], now=now)


async def stop(request: Request) -> Response:
    """Stop a run now."""
    return await _asked(request, lambda run, who, form: stop_run(run, who=who, wait_s=0), old=True)


async def pause(request: Request) -> Response:
    """Pause a run at its next checkpoint."""
    return await _asked(request, lambda run, who, form: pause_run(run, who=who, wait_s=0))


async def resume(request: Request) -> Response:
    """Let a paused run go on."""
    return await _asked(request, lambda run, who, form: resume_live_run(run, who=who, wait_s=0))


async def answer(request: Request) -> Response:
    """Answer what a run asks."""

    def answered(run: Path, who: str, form: dict[str, str]) -> Reaction:
        if form.get("answer") not in ("yes", "no"):
            raise DataError("an answer is yes or no")
        asked = read_live(run).get("prompt", "")
        if asked and asked.split() != form.get("prompt", "").split():
            raise DataError(f"{run.name} asks something else now: {asked}")
        return answer_run(run, form["answer"] == "yes", who=who, wait_s=0)

    return await _asked(request, answered)


async def _asked(
    request: Request,
    ask: Callable[[Path, str, dict[str, str]], Reaction],
    *,
    old: bool = False,
) -> Response:
    form, settings = await form_of(request, old=old), settings_of(request)
    run = run_at(request.path_params["name"], settings)
    reaction = await run_in_threadpool(_heard, lambda: ask(run, who_of(request), form), run)
    if "text/html" in request.headers.get("accept", ""):
        return RedirectResponse(address_of(run, settings), 303)
    return JSONResponse(reaction.to_dict())


def _heard(ask: Callable[[], Reaction], run: Path) -> Reaction:
    """Ask a run that need not listen yet; what it does then is seen in its events."""
    deadline = time.monotonic() + LISTENS_WITHIN_S
    while True:
        try:
            return ask()
        except DataError as error:
            deaf = "does not listen" in error.message and is_live(run)
            if not deaf or time.monotonic() >= deadline:
                raise
        time.sleep(0.05)


async def run_events(request: Request) -> Response:
    """How a live run is, whenever that has changed, until it ends; and what `events` tells.

    One connection a page: a browser keeps six to a host, and Stop must find one that is free.
    """
    settings = settings_of(request)
    known = _live_runs(settings)
    run = require_run(request.path_params["name"], settings)
    after = request.query_params.get("after", "0")
    looking = LiveRun(run, settings, int(after) if after.isdecimal() else 0)

    async def told() -> AsyncIterator[dict[str, str]]:
        seen: dict[str, Any] = {}
        before: list[dict[str, Any]] | None = None
        while not seen.get("over"):
            runs = await run_in_threadpool(known.now)
            if runs != before:
                yield {"event": "live", "data": json.dumps(runs)}
            before = runs
            now = await run_in_threadpool(looking.look)
            if now != seen:
                yield {"event": "over" if now["over"] else "run", "data": json.dumps(now)}
            seen = now | {"log": []}
            await asyncio.sleep(LOOK_EVERY_S)

    return EventSourceResponse(told(), ping=15)


async def events(request: Request) -> Response:
    """Which runs are live and where they are, whenever that has changed."""
    known = _live_runs(settings_of(request))

    async def told() -> AsyncIterator[dict[str, str]]:
        seen: list[dict[str, Any]] | None = None
        while True:
            now = await run_in_threadpool(known.now)
            if now != seen:
                yield {"event": "live", "data": json.dumps(now)}
            seen = now
            await asyncio.sleep(2 * LOOK_EVERY_S)

    return EventSourceResponse(told(), ping=15)


class _LiveRuns:
    """The live runs, looked for once for all that are told of them."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._looking = threading.Lock()
        self._until, self._seen = 0.0, list[dict[str, Any]]()

    def now(self) -> list[dict[str, Any]]:
        """What every page shows of each of them."""
        with self._looking:
            if time.monotonic() >= self._until:
                runs = live_runs(self._settings)
                self._seen = [header_of(run, self._settings) for run in runs]
                self._until = time.monotonic() + LOOK_EVERY_S
            return self._seen


@lru_cache(maxsize=4)
def _live_runs(settings: Settings) -> _LiveRuns:
    return _LiveRuns(settings)


routes = [
    Route("/events", events),
    Route("/runs/{name:path}/events", run_events),
    *(
        Route(f"/runs/{{name:path}}/{one.__name__}", one, methods=["POST"])
        for one in (stop, pause, resume, answer)
    ),
    Route("/runs/{name:path}", run_page),
]
