"""Live runs: their data on pages, and the event stream that updates the pages.

- The functions `live_headers` and `pending_starts` provide the bar at the top of every page, with
  the buttons Stop and Cancel. An invalid file in a run directory must not remove the Stop button
  from a page.
- `LiveRun` reads the files of one run repeatedly for the page of this run. The document of
  `LiveRun` contains the keys `texts` and `values` (contents of the elements with an equal
  `data-text` or `data-value`), `shown` (names of the visible elements with `data-shown`) and
  `series` (newest numbers of the elements with `data-spark`). The same document creates and updates
  the page, so that the script of the page contains no texts.
- `events` sends the bar and the documents as server-sent events. A browser opens at most six
  connections to a host, and one of them must be free for Stop. Therefore, all pages of a browser
  share one event stream, which covers every run that one of these pages shows.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

from sse_starlette import EventSourceResponse
from starlette.requests import Request
from starlette.routing import Route

from hil.core import HilError, is_live, name_read, name_text, plain
from hil.dashboard.limits import in_thread
from hil.dashboard.run_files import require_run, run_address, run_name
from hil.dashboard.settings import Settings, settings_of
from hil.engine import ENDING, PAUSED, Standing, share_words, state_words, step_words, words_of
from hil.recording import RunDirectory
from hil.report import duration, measures
from hil.runs import known_runs
from hil.spec import load_series_spec
from hil.workflow import EventTail, Started, how_it_ended, read_live, standing_in, started_runs

Document = dict[str, Any]


def live_headers(settings: Settings, within_s: float = 0.0) -> list[Document]:
    """Return the data of the bar for every live run, one result of `header_of` per run.

    Args:
        settings: Settings of the dashboard.
        within_s: Maximum age of the result [s], as in `hil.runs.live_runs.KnownRuns.live`.
    """
    root = settings.runs.resolve()
    headers = []
    for run in known_runs(settings.runs).live(within_s):
        if not run.resolve().is_relative_to(root):  # outside of the folder of runs
            continue
        try:
            headers.append(header_of(run, settings))
        except Exception:  # despite invalid files, the run can be stopped
            headers.append({
                "name": run_name(run, settings),
                "address": run_address(run, settings),
                "text": "its live state cannot be read",
                "asks": False,
                "percent": 0,
                "done": "0 %",
                "left": "",
                "silent": "",
                "over": False,
            })  # fmt: skip
    return headers


def header_of(run: Path, settings: Settings) -> Document:
    """Return the data of a live run that the bar of every page shows."""
    view = read_live(run)
    run_now, silent = standing_in(view), _silent(view)
    headline = _headline(run_now, run)
    return {
        "name": run_name(run, settings),
        "address": run_address(run, settings),
        "text": f"{silent}; last known: {headline}" if silent else headline,
        "asks": bool(run_now.prompt),
        "silent": bool(silent),
        "percent": round(100 * run_now.share),
        "done": share_words(run_now).strip(),
        "left": _left(run_now, _mapping(view.get("arm"))),
        "over": run_now.state == "done",
    }


def pending_starts(settings: Settings) -> list[dict[str, str]]:
    """Return `id`, `spec`, `text` and `address` of all starts that have no live run at the moment.

    A start without a live run is a start that has created no run yet, or a series between two runs.
    A start whose file cannot be read is omitted, because it is not a run.
    """
    return [
        {
            "id": one.id,
            "spec": name_text(Path(one.spec).name),
            "text": pending_words(one),
            "address": f"/start/{one.id}",
        }
        for one in started_runs(settings.runs)
        if _is_pending(one)
    ]


def _is_pending(started: Started) -> bool:
    """Return whether a start will create a further run, and is not merely about to exit."""
    if not started.alive:
        return False
    made = started.made
    if not made:
        return True
    if any(is_live(run) for run in made):
        return False
    try:
        count = len(load_series_spec(started.spec).series)
    except HilError:  # not a series, or the file has changed
        return False
    # A series continues after each judged run, until all of its experiments are done.
    return len(made) < count and all((run / "verdict.json").is_file() for run in made)


def pending_words(started: Started) -> str:
    """Return the activity of a start before its run is live, as a text without a subject."""
    if started.again:
        return "is about to resume"
    return "is about to start its next run" if started.made else "is being planned"


SILENT_AFTER_S = 5.0

FIRST_LINES = 30
"""Number of lines of the event log that a newly loaded page shows."""

NOT_KNOWN = "–"

FASTER = 1.5
"""Rate of a clock relative to the wall clock above which the clock counts as simulated."""

MOST_ASKED = 2000
"""Maximum number of characters of a question that a page shows."""

HELD = "interlock "
"""First word of the reason for a pause, if an interlock requested the pause."""

JOINERS = "\u200c\u200d"
"""Characters that are not printable but are required in the text of some languages."""


class LiveRun:
    """Live run on a page, whose files are read repeatedly.

    Args:
        run: Run directory.
        settings: Settings of the dashboard.
        after: Number of lines of the event log that the page already contains.
    """

    def __init__(self, run: Path, settings: Settings, after: int = 0) -> None:
        self._run, self._settings = run, settings
        self._log = EventTail(RunDirectory(run).events_path, from_start=True)
        self._lines, self._after = 0, after
        self._view: Document = {}

    def look(self) -> Document:
        """Return the document of the current state; equal to the last document without a change."""
        live = is_live(self._run)  # checked first, so that the last lines are read
        log = list(self._new_lines())
        # A run removes its live view at its end; the page retains the last one.
        self._view = (read_live(self._run) if live else {}) or self._view
        return {
            **_document(self._run, self._view, live),
            "log": log,
            "name": run_name(self._run, self._settings),
            "address": run_address(self._run, self._settings),
        }

    def _new_lines(self) -> Iterator[Document]:
        for event in self._log.read():
            self._lines += 1
            if self._lines > self._after:
                t = event.get("t")
                known = isinstance(t, int | float) and 0 <= t < 1e11
                clock = time.strftime("%H:%M:%S", time.localtime(t)) if known else "--:--:--"
                yield {"n": self._lines, "clock": clock, "text": words_of(event, self._run.name)}


def _document(run: Path, view: Document, live: bool) -> Document:
    now = standing_in(view)
    if not live:
        now.prompt = ""
    arm = _mapping(view.get("arm"))
    margins = [each for each in _list(view.get("interlocks")) if isinstance(each, dict)]
    texts = {
        "headline": _headline(now, run) if live else _ended(run),
        "percent": share_words(now).strip() if now.steps else NOT_KNOWN,
        "left": _left(now, arm) if live else NOT_KNOWN,
        "doing": step_words(now) or now.stage or NOT_KNOWN,
        "samples": f"{now.samples:,}".replace(",", " "),
        "troubles": ", ".join(now.troubles) or "none",
        "silent": _silent(view) if live else "",
        "prompt": question_words(now.prompt),
        **_joint_texts(arm),
        **{f"margin.{each.get('name')}": _margin_words(each) for each in margins},
    }
    return {
        "over": not live,
        "t": view.get("t", 0),
        "texts": texts,
        "can": _actions(now, live=live, known=bool(view)),
        "values": {
            "share": now.share,
            "asked": now.asked,
            "attempt": str(view.get("holder", "")),
            **{f"margin.{each.get('name')}": _finite(each.get("share")) for each in margins},
        },
        "shown": {
            "question": bool(now.prompt),
            "arm": bool(arm),
            "margins": bool(margins),
            "silent": bool(texts["silent"]),
            "over": not live,
        },
        "series": _series(arm),
        "joints": [str(name) for name in _list(arm.get("joints"))],
        "margins": [str(each.get("name")) for each in margins],
        "unit": str(arm.get("effort_unit", "")),
    }


def _actions(now: Standing, *, live: bool, known: bool) -> dict[str, bool]:
    """Return the requests that a run accepts; all requests if the state of the run is unknown."""
    moves = live and now.state not in ENDING
    why = now.pausing or (now.reason if now.state == PAUSED else "")
    # After a pause by an interlock, the run resumes automatically.
    by_operator = bool(why) and not why.startswith(HELD)
    return {
        "pause": moves and not (known and by_operator),
        "resume": moves and (by_operator or not known),
        "stop": live and now.state != "done",
    }


def question_words(text: str) -> str:
    """Return a question for a page, with line breaks and without unprintable characters."""
    lines = text[: MOST_ASKED + 1].splitlines()
    shown = "\n".join("".join(map(_printable, line)).rstrip() for line in lines)
    return shown if len(text) <= MOST_ASKED else shown[: MOST_ASKED - 1] + "…"


def _printable(c: str) -> str:
    if c.isspace():
        return " "
    return c if c.isprintable() or c in JOINERS else ""


def _headline(now: Standing, run: Path) -> str:
    """Return the state most important to an operator as a short text, for screen readers."""
    if now.state == "done":
        return _motion_over(now, run)
    if now.state in ENDING:
        return plain(state_words(now), most=500)
    if now.prompt:
        return "waiting for an answer"
    if now.pausing and now.state != PAUSED:
        return plain(f"running, pauses at the next checkpoint: {now.pausing}", most=500)
    if now.state == "idle":
        return plain(now.stage or "preparing", most=500)
    return plain(state_words(now), most=500)


def _motion_over(now: Standing, run: Path) -> str:
    """Return how the motion ended, and the stage that follows."""
    try:
        stop = RunDirectory(run).stop or {}
    except HilError:
        stop = {}
    outcome, reason = stop.get("outcome", "motion over"), stop.get("reason") or now.reason
    why = f": {reason}" if reason and reason != outcome else ""
    return plain(f"{outcome}{why}" + (f"; {now.stage}" if now.stage else ""), most=500)


def _ended(run: Path) -> str:
    try:
        end = how_it_ended(RunDirectory(run))
    except HilError as error:
        return plain(error.message, most=500)
    why = f": {end['reason']}" if end["reason"] else ""
    verdict = f"; model {end['verdict']}" if end["verdict"] != "not judged" else ""
    return plain(f"{end['status']}{why}{verdict}", most=500)


def _left(now: Standing, arm: Document) -> str:
    """Return a text with the remaining wall-clock time and the rate of simulated time."""
    if now.state in ENDING or not now.duration_s:
        return NOT_KNOWN
    clock = "virtual clock" if arm.get("clock") == "virtual" else ""
    if now.pace >= FASTER:
        clock = f"{clock or 'clock'} × {now.pace:.{1 if now.pace < 10 else 0}f}"
    return ", ".join(filter(None, (f"{duration(now.left_s)} left", clock)))


def _silent(view: Document) -> str:
    """Return how long the run has written nothing; empty if this time is usual."""
    t = view.get("t")
    quiet = time.time() - t if isinstance(t, int | float) else 0.0
    # There are no updates of the arm during fits.
    if quiet < SILENT_AFTER_S or view.get("state") == "done":
        return ""
    return f"no data for {quiet:.0f} s" if quiet < 60 else f"no data for {duration(quiet)}"


def _joint_texts(arm: Document) -> Document:
    columns = {
        "q": ("q_rad", math.degrees(1), ".2f"),
        "qd": ("qd_rad_s", math.degrees(1), ".1f"),
        "effort": ("effort", 1.0, ".2f"),
        "temperature": ("temperature_c", 1.0, ".1f"),
    }
    found = {
        f"{name}.{i}": _number(value, scale, form)
        for name, (key, scale, form) in columns.items()
        for i, value in enumerate(_list(arm.get(key)))
    }
    pairs = zip(_list(arm.get("q_rad")), _list(arm.get("q_target_rad")), strict=False)
    for i, (q, target) in enumerate(pairs):
        known = isinstance(q, float) and isinstance(target, float)
        found[f"lag.{i}"] = _number(q - target if known else None, math.degrees(1), ".3f")
    return found


def _margin_words(margin: Document) -> str:
    value, limit = measures(margin.get("value"), margin.get("limit"), margin.get("unit"))
    bound = "at least" if margin.get("least") else "limit"
    return plain(f"{margin.get('subject')}: {value}, {bound} {limit}", most=200)


def _series(arm: Document) -> Document:
    """Return the newest values of the curves on the page."""
    keys = {"effort": "effort", "temperature": "temperature_c"}
    return {
        f"{name}.{i}": value
        for name, key in keys.items()
        for i, value in enumerate(_list(arm.get(key)))
        if isinstance(value, int | float)
    }


def _number(value: object, scale: float, form: str) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return NOT_KNOWN
    text = format(scale * value, form)
    return text.lstrip("-") if not text.strip("-0.") else text  # no sign if rounded to zero


def _finite(value: object) -> float:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else 0.0


def _mapping(value: object) -> Document:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


LOOK_EVERY_S = 0.25

BEAT_EVERY_S = 2.0
"""Interval between heartbeat events [s]; a page that receives no events for longer marks its
data as outdated.
"""

ENDED_LOOKED_AT_S = 2.0
"""Interval between checks of ended runs [s], which are necessary because a run can be resumed."""

MOST_RUNS = 16
"""Maximum number of runs in one event stream; other runs are shown in the bar only."""

Events = AsyncIterator[dict[str, str]]


async def events(request: Request) -> EventSourceResponse:
    """Send the live runs with their addresses, and the state of every `run` in the query.

    The events of the stream are `live`, `planned`, `run`, `over` and `beat`. The query parameter
    `after` contains, for each `run`, the number of lines of its log that are already known.
    """
    settings = settings_of(request)
    names = [name_read(name) for name in request.query_params.getlist("run")[:MOST_RUNS]]
    known = request.query_params.getlist("after")[: len(names)]
    runs = []
    for name, after in zip_longest(names, known, fillvalue=""):
        # A deleted run must not end the events of the others.
        try:
            runs.append(await in_thread("stream", _open, name, after, settings))
        except HilError:
            continue
    return EventSourceResponse(_changes(_shared_bar(settings), runs), ping=15)


async def run_events(request: Request) -> EventSourceResponse:
    """Send every change of one run until its end, in addition to the bar of `events`."""
    settings, name = settings_of(request), request.path_params["name"]
    run = await in_thread("stream", _open, name, request.query_params.get("after", ""), settings)
    return EventSourceResponse(_changes(_shared_bar(settings), [run], until_ended=True), ping=15)


def _open(name: str, after: str, settings: Settings) -> LiveRun:
    lines = int(after) if after.isdecimal() and len(after) < 12 else 0
    return LiveRun(require_run(name, settings), settings, lines)


async def _changes(bar: _SharedBar, runs: list[LiveRun], *, until_ended: bool = False) -> Events:
    """Yield all changes since the last events, and regular heartbeats."""
    sent: dict[LiveRun, Document] = {}
    before = _Bar()
    beat = time.monotonic() + BEAT_EVERY_S
    while True:
        now = await in_thread("stream", bar.read)
        if now.live != before.live:
            yield {"event": "live", "data": json.dumps(now.live)}
        if now.planned != before.planned:
            yield {"event": "planned", "data": json.dumps(now.planned)}
        before = now
        for run in list(runs):
            document = await in_thread("stream", run.look)
            if document != sent.get(run):
                event = "over" if document["over"] else "run"
                yield {"event": event, "data": json.dumps(document)}
            sent[run] = document | {"log": []}  # each log line is sent once
            if document["over"]:
                runs.remove(run)
        if until_ended and not runs:
            return
        if time.monotonic() >= beat:
            yield {"event": "beat", "data": "{}"}
            beat = time.monotonic() + BEAT_EVERY_S
        await asyncio.sleep(LOOK_EVERY_S if runs else 2 * LOOK_EVERY_S)


@dataclass(frozen=True, slots=True)
class _Bar:
    """Content of the bar on every page; None before the content was read from the disk."""

    live: list[Document] | None = None
    planned: list[dict[str, str]] | None = None


class _SharedBar:
    """Bar whose content is read from the disk once for all event streams."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._reading = threading.Lock()
        self._fresh_until, self._bar = 0.0, _Bar()

    def read(self) -> _Bar:
        """Return the content of the bar: newly read, or read a short time before."""
        with self._reading:
            if time.monotonic() >= self._fresh_until:
                # Starts are read first: one that becomes live is shown twice, not omitted.
                planned = pending_starts(self._settings)
                # A start that left the list has become a live run, so search for it at once.
                within_s = ENDED_LOOKED_AT_S if planned == self._bar.planned else 0.0
                self._bar = _Bar(live_headers(self._settings, within_s), planned)
                self._fresh_until = time.monotonic() + LOOK_EVERY_S
            return self._bar


@lru_cache(maxsize=4)
def _shared_bar(settings: Settings) -> _SharedBar:
    return _SharedBar(settings)


routes = [Route("/events", events), Route("/runs/{name:place}/events", run_events)]
