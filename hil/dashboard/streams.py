"""What pages are told while they are looked at, by server-sent events.

A browser keeps six connections to a host, and Stop must find one that is free: so all pages of a
browser share one stream, which tells of every run that one of them shows.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from typing import Any

from sse_starlette import EventSourceResponse
from starlette.requests import Request

from hil.core import HilError, name_read
from hil.dashboard.going import being_planned, going_on
from hil.dashboard.live_facts import LiveRun
from hil.dashboard.rendering import settings_of
from hil.dashboard.run_files import require_run
from hil.dashboard.settings import Settings
from hil.dashboard.threads import in_thread

LOOK_EVERY_S = 0.25
BEAT_EVERY_S = 2.0
"""A page that hears nothing for longer says that what it shows is old."""

ENDED_LOOKED_AT_S = 2.0
"""How often runs that have ended are looked at: somebody may go on with one."""

MOST_RUNS = 16
"""Told of in one stream; of the rest only what every page shows."""

Told = AsyncIterator[dict[str, str]]


async def run_events(request: Request) -> EventSourceResponse:
    """How a live run is, whenever that has changed, until it ends; and what `events` tells."""
    settings, name = settings_of(request), request.path_params["name"]
    after = request.query_params.get("after", "")
    looking = await in_thread("telling", _looking, name, after, settings)
    return EventSourceResponse(_told(_live_runs(settings), [looking], ends=True), ping=15)


async def events(request: Request) -> EventSourceResponse:
    """Which runs are live and where they are, and how every `run` of the query is.

    A stream of `live`, `planned`, `run`, `over` and `beat`; `after` says for each `run` how many
    lines of its log are known.
    """
    settings = settings_of(request)
    names = [name_read(name) for name in request.query_params.getlist("run")[:MOST_RUNS]]
    known = request.query_params.getlist("after")[: len(names)]
    looking = []
    for name, after in zip_longest(names, known, fillvalue=""):
        # One that has gone is no reason to tell nothing of the others.
        try:
            looking.append(await in_thread("telling", _looking, name, after, settings))
        except HilError:
            continue
    return EventSourceResponse(_told(_live_runs(settings), looking), ping=15)


async def _told(known: _LiveRuns, looking: list[LiveRun], *, ends: bool = False) -> Told:
    seen: dict[LiveRun, dict[str, Any]] = {}
    before = _Going()
    beat = time.monotonic() + BEAT_EVERY_S
    while True:
        going = await in_thread("telling", known.now)
        if going.live != before.live:
            yield {"event": "live", "data": json.dumps(going.live)}
        if going.planned != before.planned:
            yield {"event": "planned", "data": json.dumps(going.planned)}
        before = going
        for one in list(looking):
            now = await in_thread("telling", one.look)
            if now != seen.get(one):
                yield {"event": "over" if now["over"] else "run", "data": json.dumps(now)}
            seen[one] = now | {"log": []}
            if now["over"]:
                looking.remove(one)
        if ends and not looking:
            return
        if time.monotonic() >= beat:
            yield {"event": "beat", "data": "{}"}
            beat = time.monotonic() + BEAT_EVERY_S
        await asyncio.sleep(LOOK_EVERY_S if looking else 2 * LOOK_EVERY_S)


@dataclass(frozen=True, slots=True)
class _Going:
    """What every page shows of what goes on; None before anybody has looked."""

    live: list[dict[str, Any]] | None = None
    planned: list[dict[str, str]] | None = None


class _LiveRuns:
    """The live runs and those being planned, looked for once for all that are told of them."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._looking = threading.Lock()
        self._until, self._seen = 0.0, _Going()

    def now(self) -> _Going:
        """What every page shows of each of them."""
        with self._looking:
            if time.monotonic() >= self._until:
                # Looked for first: one that has just become live is shown twice, not left out.
                planned = being_planned(self._settings)
                # One that is about to go on no more has become live.
                within_s = ENDED_LOOKED_AT_S if planned == self._seen.planned else 0.0
                self._seen = _Going(going_on(self._settings, within_s), planned)
                self._until = time.monotonic() + LOOK_EVERY_S
            return self._seen


@lru_cache(maxsize=4)
def _live_runs(settings: Settings) -> _LiveRuns:
    return _LiveRuns(settings)


def _looking(name: str, after: str, settings: Settings) -> LiveRun:
    return LiveRun(require_run(name, settings), settings, _count(after))


def _count(text: str) -> int:
    return int(text) if text.isdecimal() and len(text) < 12 else 0
