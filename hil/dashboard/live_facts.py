"""What a page shows of a live run: the same texts when it is made and while it is looked at.

A document names places of the page: `texts` are put into the elements with that `data-text`,
`values` into those with that `data-value`, `shown` says which `data-shown` are there, and `series`
are the newest numbers of `data-spark`. So the page needs no words of its own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hil.core import HilError, is_live, plain
from hil.dashboard.places import address_of, name_of
from hil.dashboard.settings import Settings
from hil.engine import ENDING, PAUSED, Standing, share_words, state_words, step_words, words_of
from hil.recording import RunDirectory
from hil.report import duration, measures
from hil.workflow import EventTail, how_it_ended, read_live, standing_in

SILENT_AFTER_S = 5.0
FIRST_LINES = 30
"""Of the event log, when a page is made."""

NOT_KNOWN = "–"

FASTER = 1.5
"""A clock that goes so many times as fast as that on the wall is a simulation's."""

MOST_ASKED = 2000
"""Characters of a question that are shown."""

HELD = "interlock "
"""So begins why a run is paused that nobody but an interlock holds: it goes on by itself."""

JOINERS = "\u200c\u200d"
"""Not printable by themselves, but words of some languages need them."""

Document = dict[str, Any]


class LiveRun:
    """Looks at a run again and again.

    Args:
        run: The run directory.
        settings: What is served.
        after: Lines of its event log that are known already.
    """

    def __init__(self, run: Path, settings: Settings, after: int = 0) -> None:
        self._run, self._settings = run, settings
        self._log = EventTail(RunDirectory(run).events_path, from_start=True)
        self._lines, self._after = 0, after
        self._view: Document = {}

    def look(self) -> Document:
        """How it is now; the same as before where nothing has changed."""
        live = is_live(self._run)  # asked first: what was written before the end is read after it
        log = list(self._new_lines())
        # A run that ends takes its view away; what was measured until then is not nothing.
        self._view = (read_live(self._run) if live else {}) or self._view
        return {**_shown(self._run, self._view, live), "log": log, **self._where()}

    def _where(self) -> Document:
        return {
            "name": name_of(self._run, self._settings),
            "address": address_of(self._run, self._settings),
        }

    def _new_lines(self) -> Iterator[Document]:
        for event in self._log.read():
            self._lines += 1
            if self._lines > self._after:
                yield _line(self._lines, event, self._run.name)


def header_of(run: Path, settings: Settings) -> Document:
    """What every page shows of a live run."""
    view = read_live(run)
    run_now, silent = standing_in(view), _silent(view)
    headline = _headline(run_now, run)
    return {
        "name": name_of(run, settings),
        "address": address_of(run, settings),
        "text": f"{silent}; last known: {headline}" if silent else headline,
        "asks": bool(run_now.prompt),
        "silent": bool(silent),
        "percent": round(100 * run_now.share),
        "done": share_words(run_now).strip(),
        "left": _left(run_now, _mapping(view.get("arm"))),
        "over": run_now.state == "done",
    }


def _shown(run: Path, view: Document, live: bool) -> Document:
    now = standing_in(view)
    if not live:
        now.prompt = ""
    arm = _mapping(view.get("arm"))
    margins = [each for each in _listed(view.get("interlocks")) if isinstance(each, dict)]
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
        **_margin_texts(margins),
    }
    return {
        "over": not live,
        "t": view.get("t", 0),
        "texts": texts,
        "can": _can(now, live=live, known=bool(view)),
        "values": {
            "share": now.share,
            "asked": now.asked,
            "attempt": str(view.get("holder", "")),
            **_margin_values(margins),
        },
        "shown": {
            "question": bool(now.prompt),
            "arm": bool(arm),
            "margins": bool(margins),
            "silent": bool(texts["silent"]),
            "over": not live,
        },
        "series": _series(arm),
        "joints": [str(name) for name in _listed(arm.get("joints"))],
        "margins": [str(each.get("name")) for each in margins],
        "unit": str(arm.get("effort_unit", "")),
    }


def _can(now: Standing, *, live: bool, known: bool) -> dict[str, bool]:
    """What can be asked of it now; of one that tells nothing everything, for it may take it."""
    moves = live and now.state not in ENDING
    why = now.pausing or (now.reason if now.state == PAUSED else "")
    asked = bool(why) and not why.startswith(HELD)
    return {
        "pause": moves and not (known and asked),
        "resume": moves and (asked or not known),
        "stop": live and now.state != "done",
    }


def question_words(text: str) -> str:
    """A question as it is shown: its lines are kept, what no page can show is left out."""
    lines = text[: MOST_ASKED + 1].splitlines()
    said = "\n".join("".join(map(_shown_as, line)).rstrip() for line in lines)
    return said if len(text) <= MOST_ASKED else said[: MOST_ASKED - 1] + "…"


def _shown_as(c: str) -> str:
    if c.isspace():
        return " "
    return c if c.isprintable() or c in JOINERS else ""


def _headline(now: Standing, run: Path) -> str:
    """What a person has to know first; short, for it is read aloud when it changes."""
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
    """How the motion ended, and what is being made of it."""
    try:
        stop = RunDirectory(run).stop or {}
    except HilError:
        stop = {}
    outcome, reason = stop.get("outcome", "motion over"), stop.get("reason") or now.reason
    told = f": {reason}" if reason and reason != outcome else ""
    return plain(f"{outcome}{told}" + (f"; {now.stage}" if now.stage else ""), most=500)


def _ended(run: Path) -> str:
    try:
        end = how_it_ended(RunDirectory(run))
    except HilError as error:
        return plain(error.message, most=500)
    told = f": {end['reason']}" if end["reason"] else ""
    verdict = f"; model {end['verdict']}" if end["verdict"] != "not judged" else ""
    return plain(f"{end['status']}{told}{verdict}", most=500)


def _left(now: Standing, arm: Document) -> str:
    """By the clock on the wall; where simulated time passes at another rate, that is said."""
    if now.state in ENDING or not now.duration_s:
        return NOT_KNOWN
    clock = "virtual clock" if arm.get("clock") == "virtual" else ""
    if now.pace >= FASTER:
        clock = f"{clock or 'clock'} × {now.pace:.{1 if now.pace < 10 else 0}f}"
    return ", ".join(filter(None, (f"{duration(now.left_s)} left", clock)))


def _silent(view: Document) -> str:
    told = view.get("t")
    quiet = time.time() - told if isinstance(told, int | float) else 0.0
    # While models are fitted nothing is heard of the arm, and nothing need be.
    if quiet < SILENT_AFTER_S or view.get("state") == "done":
        return ""
    return f"no news for {quiet:.0f} s" if quiet < 60 else f"no news for {duration(quiet)}"


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
        for i, value in enumerate(_listed(arm.get(key)))
    }
    pairs = zip(_listed(arm.get("q_rad")), _listed(arm.get("q_target_rad")), strict=False)
    for i, (q, target) in enumerate(pairs):
        known = isinstance(q, float) and isinstance(target, float)
        found[f"lag.{i}"] = _number(q - target if known else None, math.degrees(1), ".3f")
    return found


def _margin_texts(margins: list[Document]) -> Document:
    return {f"margin.{each.get('name')}": _margin_words(each) for each in margins}


def _margin_words(margin: Document) -> str:
    value, limit = measures(margin.get("value"), margin.get("limit"), margin.get("unit"))
    bound = "at least" if margin.get("least") else "limit"
    return plain(f"{margin.get('subject')}: {value}, {bound} {limit}", most=200)


def _margin_values(margins: list[Document]) -> Document:
    return {f"margin.{each.get('name')}": _finite(each.get("share")) for each in margins}


def _series(arm: Document) -> Document:
    """The newest numbers of what is drawn."""
    keys = {"effort": "effort", "temperature": "temperature_c"}
    return {
        f"{name}.{i}": value
        for name, key in keys.items()
        for i, value in enumerate(_listed(arm.get(key)))
        if isinstance(value, int | float)
    }


def _line(number: int, event: Document, run: str) -> Document:
    told = event.get("t")
    known = isinstance(told, int | float) and 0 <= told < 1e11
    clock = time.strftime("%H:%M:%S", time.localtime(told)) if known else "--:--:--"
    return {"n": number, "clock": clock, "text": words_of(event, run)}


def _number(value: object, scale: float, form: str) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return NOT_KNOWN
    text = format(scale * value, form)
    return text.lstrip("-") if not text.strip("-0.") else text  # rounded to zero: no sign


def _finite(value: object) -> float:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else 0.0


def _mapping(value: object) -> Document:
    return value if isinstance(value, dict) else {}


def _listed(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
