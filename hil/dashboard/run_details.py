"""What a run was, in words: who measured what, when, by which clock, and how much of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hil.core import HilError
from hil.recording import RunDirectory
from hil.report import (
    PLURALS,
    Document,
    RunFacts,
    as_float,
    as_object,
    as_objects,
    count,
    counted,
    duration,
    number,
    verdict_words,
    when,
)

VIRTUAL = "virtual: simulated, no robot moved; times are those of the simulation"


def is_virtual(run: Path) -> bool:
    """Whether simulated time drives a run; of one that does not say so it is not known."""
    try:
        return virtual_clock(RunDirectory(run).start)
    except HilError:
        return False


def virtual_clock(start: Document) -> bool:
    """The same of its start document."""
    return as_object(start.get("robot")).get("clock") == "virtual"


def details_of(facts: RunFacts) -> Iterator[tuple[str, str]]:
    """Label and text each; empty where nothing is known."""
    start, identity = facts.start, as_object(facts.robot.get("identity"))
    code = facts.stop.get("exit_code")
    yield "description", str(facts.spec.get("description") or "")
    yield "started", when(start.get("started"))
    yield "ended", when(facts.stop.get("stopped"))
    yield "robot", str(start.get("robot_name") or facts.path.parent.name)
    yield "clock", VIRTUAL if virtual_clock(facts.start) else ""
    yield "arm", str(facts.robot.get("model") or "")
    yield "serial number", str(identity.get("serial") or "")
    yield "operator", str(start.get("operator") or "")
    yield "part of the program", facts.commissioning
    yield "loads", ", ".join(_load(load) for load in as_objects(start.get("loads")))
    yield "occasion", str(start.get("occasion") or "")
    yield "program", _program(facts)
    yield "recorded", _recorded(facts)
    yield "verdict", verdict_words(facts)
    yield "reason of the end", str(facts.stop.get("reason") or "")
    yield "exit code", "" if code is None else str(code)


def _load(load: Document) -> str:
    mass = as_float(load.get("mass_kg"))
    return " ".join(filter(None, (str(load.get("name") or ""), f"{number(mass)} kg")))


def _program(facts: RunFacts) -> str:
    if not facts.steps:
        return ""
    kinds = [str(step.get("kind")) for step in facts.steps]
    counts = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}
    told = ", ".join(
        f"{n} {kind if n == 1 else PLURALS.get(kind, f'{kind}s')}" for kind, n in counts.items()
    )
    ended = f"; ended in {facts.ended_in}" if facts.ended_in else ""
    return f"{counted(len(kinds), 'step')}: {told}{ended}"


def _recorded(facts: RunFacts) -> str:
    told = facts.recorded
    if "samples" not in told:
        return ""
    took = duration(as_float(told.get("device_s")))
    missing = f"{told.get('missing', 0)} missing in {counted(told.get('gaps', 0), 'gap')}"
    samples = told["samples"]
    shown = count(samples) if isinstance(samples, int) else samples
    return f"{shown} sample{'' if samples == 1 else 's'} in {took}; {missing}"


def completeness_of(facts: RunFacts) -> Iterator[dict[str, Any]]:
    """How much of what was to be measured was."""
    for kind, told in as_object(facts.recorded.get("complete")).items():
        done, of = (as_float(as_object(told).get(key)) for key in ("done", "of"))
        if of > 0 and done >= 0:
            yield {"kind": kind, "done": int(done), "of": int(of)}
