"""Lines of the event log of a run, for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hil.core import plain
from hil.engine.standing_words import answer_words

MOST = 2000
"""Characters of one line; what files say was written by anybody."""

Item = Mapping[str, Any]


def words_of(event: Item, run: str) -> str:
    """One event of the log, for people."""
    known = _WORDS.get(str(event["kind"]), _any)
    try:
        told = known(event, run)
    except (KeyError, TypeError, ValueError):  # written by another version
        told = _any(event, run)
    return plain(told, most=MOST)


def _any(event: Item, run: str) -> str:
    details = {key: value for key, value in event.items() if key not in ("t", "time", "kind")}
    return " ".join([str(event["kind"]), *(f"{key}={value}" for key, value in details.items())])


def _asked(event: Item, run: str) -> str:
    return f"asks: {event['text']} (answer: hil answer {run} yes)"


def _control(event: Item, run: str) -> str:
    reason = f": {event['reason']}" if event.get("reason") else ""
    refused = f" (not done: {event['problem']})" if event.get("problem") else ""
    return f"{event.get('who', 'somebody')} asked to {event['what']}{reason}{refused}"


def _dwell(event: Item, run: str) -> str:
    how = "settled" if event["settled"] else "did not settle"
    return f"step {event['step'] + 1}: dwell {how} in {event['elapsed_s']:.2f} s"


def _state(event: Item, run: str) -> str:
    return f"{event['state']}" + (f": {event['reason']}" if event.get("reason") else "")


def _weighing(event: Item, run: str) -> str:
    if event["result"] == "skipped":
        return f"loads are not weighed: {event['reason']}"
    load, why = event["load"], event.get("problem")
    if event["result"] == "first":
        return f"load {load} weighed: the others are compared with it"
    return f"load {load} weighed: {event['result']}" + (f": {why}" if why else "")


def _interlocks(event: Item, run: str) -> str:
    told = (f"{one['name']} {one['limit'] or one['action']}" for one in event["watching"])
    return f"watched by interlocks: {', '.join(told)}"


_WORDS: dict[str, Callable[[Item, str], str]] = {
    "interlocks": _interlocks,
    "state": _state,
    "checkpoint": lambda event, run: f"step {event['step'] + 1}: checkpoint",
    "dwell": _dwell,
    "payload": lambda event, run: f"load {event['load']}: {event['mass_kg']:g} kg set",
    "asked": _asked,
    "prompt": lambda event, run: answer_words(event),
    "paused": lambda event, run: f"paused: {event['reason']}",
    "resumed": lambda event, run: f"resumed by {event['by']}",
    "trip": lambda event, run: f"tripped: {event['reason']}",
    "control": _control,
    "weighing": _weighing,
}
