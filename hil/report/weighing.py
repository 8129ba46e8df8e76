"""What the weighing of the loads came to, in words; from the event log."""

from __future__ import annotations

from hil.report.documents import Document, as_float
from hil.report.facts import RunFacts
from hil.report.load_names import load_name

DOUBTFUL = {
    "waived": "The failed weighing was waived",
    "inconclusive": "The weighing cannot tell which load is mounted",
}
"""Results of a weighing after which a run goes on, and what they say about it."""


def weighings(facts: RunFacts) -> dict[str, str]:
    """Load → what was weighed, as it was weighed last; empty for a run without a sweep."""
    told: dict[str, str] = {}
    for event in facts.events_of("weighing"):
        result = event.get("result")
        if result == "skipped":
            told["loads"] = f"not weighed: {event.get('reason')}"
        elif result == "first":
            told.pop(load_name(facts, 0), None)
        else:
            told.pop("loads", None)
            told[load_name(facts, event.get("load"))] = _words(event)
    return told


def weighing_warnings(facts: RunFacts) -> list[str]:
    """A sentence for every load that may not be the declared one and was measured all the same."""
    newest = {e.get("load"): e for e in facts.events_of("weighing") if e.get("result") != "skipped"}
    told = ((DOUBTFUL.get(str(event.get("result"))), event) for event in newest.values())
    return [
        f"{doubtful}: {load_name(facts, event.get('load'))}: {_problem(event)}."
        for doubtful, event in told
        if doubtful
    ]


def _words(event: Document) -> str:
    if event.get("result") != "passed":
        return _problem(event)
    declared, weighed, deviation = (
        as_float(event.get(key)) for key in ("declared_kg", "weighed_kg", "deviation_kg")
    )
    return f"{declared:.2f} kg declared, {weighed:.2f} ± {deviation:.2f} kg weighed"


def _problem(event: Document) -> str:
    """Its first line, without the number of the load."""
    line = str(event.get("problem") or "").partition("\n")[0]
    return line.removeprefix(f"load {event.get('load')}: ")
