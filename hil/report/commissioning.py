"""What follows a commissioning run: more of the program, then all of its speed."""

from __future__ import annotations

import shlex
from pathlib import Path

from hil.report.documents import as_float, as_object
from hil.report.facts import RunFacts


def next_commissioning(facts: RunFacts) -> str:
    """The next step of commissioning; the same one again after a run that ended early.

    First all poses at the same speed, then the whole program. Empty while the run goes on, and
    for a run that does not say where its spec is.
    """
    spec, station = str(facts.start.get("spec") or ""), str(facts.start.get("station") or "")
    if not spec or facts.status in ("running", "damaged"):
        return ""
    again = facts.status != "completed"
    told = as_object(facts.start.get("commissioning"))
    words = ["hil", "run", spec]
    words += ["--station", station] if Path(station).suffix else []
    first, first_s, speed = told.get("first"), told.get("first_s"), as_float(told.get("speed"))
    part = str(first) if first else f"{as_float(first_s):g}s" if first_s else ""
    if speed < 1.0 and (part or again):
        words += ["--speed", f"{100 * speed:g}%"]
    if part and again:
        words += ["--first", part]
    return shlex.join(words)
