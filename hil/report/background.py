"""Sections to look things up in: timeline, preflight checks, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.facts import RunFacts
from hil.report.load_names import load_name
from hil.report.page import Block, Cell, Column, Facts, Section, Table, cells, items
from hil.report.words import duration, in_words, number

MOST_EVENTS = 200
ROUTINE = ("dwell", "checkpoint")
"""Events of which there are thousands; the timeline counts them instead of listing them."""

GIVEN_ONCE = ("t", "time", "kind")


def timeline(facts: RunFacts) -> Section:
    """What happened when, without the thousands of routine events."""
    shown = [event for event in facts.events if event.get("kind") not in ROUTINE]
    begin = as_float(facts.events[0].get("t")) if facts.events else float("nan")
    columns = tuple(Column(title, number=False) for title in ("after", "event", "details"))
    rows = tuple(_event(facts, event, begin) for event in shown[:MOST_EVENTS])
    left_out = [f"{len(facts.events_of(kind))} × {kind}" for kind in ROUTINE]
    note = f"Not listed: {', '.join(left_out)}. Times are wall time."
    if len(shown) > MOST_EVENTS:
        note += f" Only the first {MOST_EVENTS} of {len(shown)} events are shown."
    table = Table("Events of the run", columns, rows, note)
    lead = "" if rows else "No events were logged."
    return Section("timeline", "Timeline", lead, (table,) if rows else ())


def preflight(facts: RunFacts) -> Section | None:
    """The checks before motion; None when their results were not kept."""
    checks = as_objects(facts.preflight.get("checks"))
    if not checks:
        return None
    columns = tuple(Column(title, number=False) for title in ("check", "result", "details"))
    table = Table("Checks before motion", columns, tuple(_check(check) for check in checks))
    passed = all(check.get("passed") for check in checks)
    return Section("preflight", "Preflight", "", (table,), folded=passed)


def provenance(facts: RunFacts) -> Section:
    """Where the numbers come from: run, code, robot, loads, packages."""
    packages = Facts("Packages", items(as_object(facts.start.get("packages"))))
    blocks: list[Block] = [
        Facts("Run", items(_run(facts))),
        Facts("Code and plan", items(_code(facts))),
        Facts("Robot", items(_robot(facts))),
    ]
    if loads := as_objects(facts.plan.get("loads")):
        blocks.append(_loads(loads))
    return Section("provenance", "Provenance", "", (*blocks, packages), folded=True)


def _event(facts: RunFacts, event: Document, begin: float) -> tuple[Cell, ...]:
    after = duration(as_float(event.get("t")) - begin)
    told = dict(event)
    if isinstance(told.get("load"), int):
        told["load"] = load_name(facts, told["load"])
    details = ", ".join(f"{k}: {in_words(v)}" for k, v in told.items() if k not in GIVEN_ONCE)
    kind = str(event.get("kind"))
    return Cell(after), Cell(kind, "fail" if kind == "trip" else ""), Cell(details or "–")


def _check(check: Document) -> tuple[Cell, ...]:
    result = Cell("passed", "pass") if check.get("passed") else Cell("failed", "fail")
    if check.get("waived"):
        result = Cell("failed, waived", "warn")
    return Cell(str(check.get("name"))), result, Cell(str(check.get("message") or "–"))


def _run(facts: RunFacts) -> Mapping[str, Any]:
    start = facts.start
    names = ("uid", "experiment", "started", "operator", "host", "station", "seed")
    waivers = start.get("waivers")
    return {
        **{name: start.get(name) for name in names},
        "stopped": facts.stop.get("stopped"),
        "commissioning": as_object(start.get("commissioning")).get("text"),
        "waivers": ", ".join(map(_waiver, waivers)) if isinstance(waivers, list) else waivers,
    }


def _code(facts: RunFacts) -> Mapping[str, Any]:
    start, git = facts.start, as_object(facts.start.get("git"))
    dirty = git.get("dirty")
    return {
        "spec hash": start.get("spec_hash"),
        "plan hash": start.get("plan_hash"),
        "git commit": git.get("sha"),
        "uncommitted changes": ("yes" if dirty else "no") if isinstance(dirty, bool) else None,
        "python": start.get("python"),
        "platform": start.get("platform"),
    }


def _robot(facts: RunFacts) -> Mapping[str, Any]:
    robot, identity = facts.robot, as_object(facts.robot.get("identity"))
    gains = robot.get("drive_gains")
    return {
        "model": robot.get("model"),
        **{name: identity.get(name) for name in ("serial", "firmware", "driver")},
        **as_object(identity.get("details")),
        "measures": robot.get("effort_kind"),
        "drive gains [N·m/A]": ", ".join(map(str, gains)) if isinstance(gains, list) else None,
        "drive gains from": robot.get("drive_gains_source"),
        "clock": robot.get("clock"),
    }


def _loads(loads: Any) -> Table:
    columns = (
        Column("number in the spec", number=False),
        Column("mass [kg]"),
        Column("centre of mass [m]"),
        Column("asked of the operator", number=False),
    )
    rows = tuple(
        cells(
            str(i),
            number(as_float(load.get("mass_kg"))),
            _vector(load.get("com_m")),
            str(load.get("prompt") or "–"),
        )
        for i, load in enumerate(loads)
    )
    return Table("Declared payloads", columns, rows)


def _vector(value: Any) -> str:
    given = value if isinstance(value, list) else ()
    return ", ".join(f"{as_float(item):g}" for item in given) or "–"


def _waiver(waiver: Any) -> str:
    """What was waived, why and by whom."""
    if not isinstance(waiver, dict):
        return str(waiver)
    return f"{waiver.get('check')} ({waiver.get('reason')}; {waiver.get('who')})"
