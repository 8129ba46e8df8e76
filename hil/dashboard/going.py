"""What is going on, as every page shows it at its top: live runs, and those that are being planned.

Nothing that a run directory holds may keep Stop from a page.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hil.core import HilError, is_live, name_text
from hil.dashboard.live_facts import header_of
from hil.dashboard.places import address_of, live_runs, name_of
from hil.dashboard.settings import Settings
from hil.spec import load_series_spec
from hil.workflow import Started, started_runs


def going_on(settings: Settings, within_s: float = 0.0) -> list[dict[str, Any]]:
    """See `hil.dashboard.live_facts.header_of`, of every live run.

    Args:
        settings: What is served.
        within_s: See `hil.runs.live_runs.KnownRuns.live`.
    """
    return [_header(run, settings) for run in live_runs(settings, within_s)]


def being_planned(settings: Settings) -> list[dict[str, str]]:
    """What was started here and is no live run yet, or between two (id, spec, text, address).

    A start that cannot be looked at is left out: it is no run.
    """
    return [
        {
            "id": one.id,
            "spec": name_text(Path(one.spec).name),
            "text": words_of(one),
            "address": f"/start/{one.id}",
        }
        for one in started_runs(settings.runs)
        if _is_planned(one)
    ]


def words_of(planned: Started) -> str:
    """What it does before it is a live run."""
    if planned.again:
        return "is about to go on"
    return "is about to begin its next run" if planned.made else "is being planned"


def _is_planned(started: Started) -> bool:
    """Whether a run is to come of it: of a process that only closes none does."""
    if not started.alive:
        return False
    made = started.made
    return not made or (not any(is_live(run) for run in made) and _is_between(started, made))


def _is_between(started: Started, made: list[Path]) -> bool:
    """Whether it is a series with experiments left, which goes on after runs that were judged."""
    try:
        count = len(load_series_spec(started.spec).series)
    except HilError:  # an experiment, or changed since
        return False
    return len(made) < count and all((run / "verdict.json").is_file() for run in made)


def _header(run: Path, settings: Settings) -> dict[str, Any]:
    try:
        return header_of(run, settings)
    except Exception:  # whatever its files say: it can be stopped
        return {
            "name": name_of(run, settings),
            "address": address_of(run, settings),
            "text": "its live view cannot be read",
            "asks": False,
            "percent": 0,
            "done": "0 %",
            "left": "",
            "silent": "",
            "over": False,
        }
