"""Which runs newer ones can stand in for: what `hil prune --keep N` counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.recording import RunDirectory
from hil.runs.facts import started_s
from hil.runs.together import start_of


def measured_after(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Run → how many of its robot and experiment were measured in full after it.

    Args:
        entries: As of `hil.runs.view.find_runs`.
    """
    count: Counter[tuple[str, str]] = Counter()
    newer: dict[str, int] = {}
    of_one: dict[str, int] = {}  # a run by a link, and its copy, are no further ones
    for run in sorted(entries, key=lambda one: (started_s(one) or 0.0, one["number"]))[::-1]:
        kind, identity = (run["robot"], run["name"]), run["uid"] or run["run"]
        if identity not in of_one:
            of_one[identity] = count[kind]
            count[kind] += _in_full(run)
        newer[run["run"]] = of_one[identity]
    return newer


def _in_full(facts: Mapping[str, Any]) -> bool:
    """Whether a run can take an older one's place: no rehearsal, and nothing wrong with it."""
    run = Path(facts["run"])
    good = facts["status"] == "completed" and facts["verdict"] != "rejected"
    return good and bool(RunDirectory(run).recordings) and "commissioning" not in start_of(run)
