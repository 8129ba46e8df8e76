"""Recommendation of the next `hil` command for a run.

For a run that ended early, the recommendation is to resume; for a run without models, to fit
models; and so on until no step remains. For a commissioning run, the recommendation is the next
commissioning step.
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
    """Return the next command for the run directory `run`; empty if no step remains."""
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
    """Return the estimator that suits the motions in a recording without a spec."""
    found = as_object(facts.recorded.get("complete"))
    standing = "dwell" in found and "trajectory" not in found
    return "static-wls" if standing else "rigid-wls"


def _can_be_resumed(facts: RunFacts) -> bool:
    """Return whether `hil resume` can measure or evaluate missing parts of the run."""
    if not facts.whole or RunDirectory(facts.path).is_judged:
        return False
    unjudged = facts.status == "completed" and "replayed" not in facts.start
    return unjudged or facts.status in RESUMABLE


def _parameters_of_first(facts: RunFacts) -> str:
    """Return the parameters of the first fit in the spec as shell options.

    The shell options are needed because `hil fit` does not read the spec.
    """
    first = as_objects(facts.spec.get("fit"))[0]
    given = (f"{name}={json.dumps(value)}" for name, value in first.items() if name != "estimator")
    return "".join(f" --set {shlex.quote(text)}" for text in given)


def next_commissioning(facts: RunFacts) -> str:
    """Return the command for the next step of commissioning.

    If a commissioning run ended early, the command repeats the run. After a part of the program,
    the command runs the whole program at the same speed. After the whole program, the command runs
    the whole program at full speed. The command is empty for an active or damaged run, and for a
    run that does not store the path of its spec.
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
        words += ["--speed-scale", f"{100 * speed:g}%"]
    if part and again:
        words += ["--limit", part]
    return shlex.join(words)
