"""What the page of a schedule shows, as text."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import islice, takewhile
from typing import Any

from hil.core import HilError, duration_text, shell_word
from hil.dashboard.registered import run_link
from hil.dashboard.schedules_known import Known, moment_words
from hil.dashboard.settings import Settings
from hil.maintenance import Expected, Line, Motions, forecast, occasion_of, occasions
from hil.spec import Blackout, ScheduleSpec, Trigger

FORESEEN = 12
MOST_MISSED = 3000
"""Occasions between the last that is settled and now; more are not looked through for a page."""

MARKS = {"done": "pass", "failed": "fail", "missed": "warn", "held": "warn"}


def row_of(one: Known) -> dict[str, Any]:
    """What a row of the table of schedules says."""
    begun = bool(one.ledger and one.ledger.lines)
    due, lines = one.due(1), one.ledger.lines if one.ledger else []
    last = next((line for line in reversed(lines) if line["event"] in MARKS), None)
    return {
        "name": one.name,
        "address": one.address,
        "description": one.spec.description if one.spec else "",
        "begun": begun,
        "held": one.held if begun or one.ledger is None else "",
        "run_by": one.run_by,
        "next": f"{due[0][1]}, {moment_words(due[0][0], one.zone)} ({one.zone})" if due else "",
        "last": _summary(last) if last else "",
        "last_event": str(last["event"]) if last else "",
        "last_mark": MARKS.get(str(last["event"]), "quiet") if last else "",
        "damaged": bool(one.problems),
        "zone": str(one.zone),
    }


def _summary(line: Line) -> str:
    result = line.get("result")
    if isinstance(result, dict):
        return f"{result.get('outcome', '')}: {result.get('text', '')}"
    return str(line.get("why") or "")


def expected_of(one: Known) -> tuple[list[Expected], str]:
    """What would happen next if it ran from now on, and why that cannot be told."""
    if one.ledger is None:
        return [], "It cannot be told: the ledger is damaged."
    if one.spec is None:
        return [], "It cannot be told: its file is damaged, or not among those offered here."
    now, standing = datetime.now(UTC), one.ledger.standing
    if standing.until and standing.anchor:
        missed = occasions(one.spec, standing.anchor, standing.until)
        past = takewhile(lambda each: each.due <= now, missed)
        if sum(1 for _ in islice(past, MOST_MISSED)) >= MOST_MISSED:
            return [], "Too much was missed to look through it here; hil schedule plan does."
    due = one.due(FORESEEN)
    end = due[-1][0] + timedelta(seconds=1) if due else now + timedelta(seconds=1)
    try:
        return forecast(one.spec, one.ledger, Motions(), now, end), ""
    except HilError as error:
        return [], error.message


def foreseen(each: Expected, one: Known) -> dict[str, Any]:
    """A row of what is due."""
    late = each.begins and each.begins > each.due + timedelta(seconds=59)
    return {
        "due": moment_words(each.due, one.zone),
        "job": each.job + (f" and {each.count - 1} more" if each.count > 1 else ""),
        "missed": each.begins is None,
        "begins": moment_words(each.begins, one.zone) if each.begins and late else "",
        "why": "gone on with" if each.again and not each.why else each.why,
    }


def open_of(one: Known) -> str:
    """What is under way or waits, in words."""
    standing = one.ledger.standing if one.ledger else None
    if standing is None or standing.open is None:
        return ""
    what = f"{standing.open.job} due {moment_words(standing.open.due, one.zone)}"
    return f"{what}: begun" if standing.begun else f"{what}: waits, {standing.why or 'not begun'}"


def told_of(line: Line, one: Known, settings: Settings) -> dict[str, Any]:
    """A row of the history."""
    result = line.get("result")
    runs = result.get("runs") if isinstance(result, dict) else None
    count = line.get("count")
    return {
        "at": moment_words(datetime.fromisoformat(line["at"]), one.zone),
        "event": line["event"],
        "mark": MARKS.get(line["event"], "quiet"),
        "occasion": _occasion(line, one),
        "more": count - 1 if isinstance(count, int) and count > 1 else 0,
        "what": _summary(line),
        "by": str(line.get("by") or ""),
        "runs": [
            {"stage": stage, **run_link(str(folder), settings)}
            for stage, folder in (runs.items() if isinstance(runs, dict) else ())
        ],
    }


def _occasion(line: Line, one: Known) -> str:
    try:
        told = occasion_of(str(line.get("occasion", "")))
    except ValueError:
        return ""
    return f"{told.job}, {moment_words(told.due, one.zone)}"


def facts_of_schedule(one: Known) -> list[tuple[str, str]]:
    """What its file says."""
    spec = one.spec
    if spec is None:
        return [("state", str(one.folder))]
    found = [
        ("file", str(one.file)),
        ("probe", _trigger(spec.probe, spec.probe.spec) if spec.probe else "none"),
        ("campaign", _trigger(spec.campaign, spec.campaign.spec)),
        ("when a probe shows a change", "the campaign follows" if spec.campaign.on_drift else ""),
        ("models", spec.model or "those of the campaign's robot"),
        ("what could not be done on time", _missed(spec)),
        ("state", str(one.folder)),
    ]
    return [(label, text) for label, text in found if text]


def _trigger(trigger: Trigger, spec: str) -> str:
    when = duration_text(trigger.every) if trigger.every else trigger.cron
    every = "every " if trigger.every else ""
    return f"{spec.rpartition('/')[2]}: {f'{every}{when}' if when else 'only after a change'}"


def _missed(spec: ScheduleSpec) -> str:
    within = duration_text(spec.missed_within)
    return f"done within {within}" if spec.missed == "run" else "left out"


def blackouts_of(spec: ScheduleSpec | None) -> list[dict[str, str]]:
    """Rows of its blackouts."""
    return [_blackout(one) for one in spec.blackout] if spec else []


def _blackout(one: Blackout) -> dict[str, str]:
    first, last = (str(day) if day else "" for day in (one.first, one.last))
    span = f"from {first} " * bool(first) + f"until {last}" * bool(last)
    return {
        "days": ", ".join(one.days) or "every day",
        "hours": f"{one.begin} to {one.end}",
        "season": span.strip() or "always",
        "why": one.why,
    }


def commands_for(one: Known, settings: Settings) -> list[tuple[str, str]]:
    """What is done in a terminal: words and command."""
    file = shell_word(one.file or "FILE")
    state = f"--state {shell_word(one.folder)}"
    where = f"--registry {shell_word(settings.registry)}"
    runs = f"--runs {shell_word(settings.runs)}"
    return [
        ("Do what is due, whenever it is:", f"hil schedule run {file} {state} {where} {runs}"),
        ("Foresee it, with the time its programs take:", f"hil schedule plan {file} {state}"),
    ]
