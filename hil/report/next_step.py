"""The command to type next about a run.

A run that ended early is resumed, one without models is fitted, and so on to a run with which
nothing is left to do. A commissioning run leads to the next step of commissioning.
"""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from hil.recording import RunDirectory
from hil.report.documents import as_float, as_object, as_objects
from hil.report.run_facts import RunFacts

RESUMABLE = ("interrupted", "stopped", "tripped", "failed")


def next_command(facts: RunFacts, run: str) -> str:
    """What to type next about the run at `run`; empty when nothing is left to do."""
    wanted = facts.estimators_wanted
    if facts.commissioning:
        return next_commissioning(facts)
    if facts.start.get("passive"):
        return "" if facts.fits else f"hil fit {run} --estimator {_fitting(facts)}"
    if _can_be_resumed(facts):
        return f"hil resume {run}"
    if facts.status == "completed" and wanted and not facts.fits:
        return f"hil fit {run} --estimator {wanted[0]}{_parameters_of_first(facts)}"
    if facts.status == "completed" and facts.studies_missing:
        return f"hil study {run}"
    if facts.status == "completed" and not (wanted or facts.fits or facts.spec.get("study")):
        weigh, fit = f"hil payload MODEL {run}", f"hil fit {run} --estimator rigid-wls"
        return weigh if facts.is_dwell_program else fit
    return ""


def _fitting(facts: RunFacts) -> str:
    """The estimator for what was found in a recording without spec."""
    found = as_object(facts.recorded.get("complete"))
    standing = "dwell" in found and "trajectory" not in found
    return "static-wls" if standing else "rigid-wls"


def _can_be_resumed(facts: RunFacts) -> bool:
    """Return whether `hil resume` has something left to measure or to judge."""
    if not facts.whole or RunDirectory(facts.path).is_judged:
        return False
    unjudged = facts.status == "completed" and "replayed" not in facts.start
    return unjudged or facts.status in RESUMABLE


def _parameters_of_first(facts: RunFacts) -> str:
    """Those the spec gives its first fit, for a shell: `hil fit` reads no spec."""
    first = as_objects(facts.spec.get("fit"))[0]
    given = (f"{name}={json.dumps(value)}" for name, value in first.items() if name != "estimator")
    return "".join(f" --set {shlex.quote(text)}" for text in given)


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
