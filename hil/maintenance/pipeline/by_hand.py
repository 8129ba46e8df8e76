"""A schedule's work done once, now, because somebody asked: `hil reidentify`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from hil.engine import Observer
from hil.maintenance.pipeline.bound import bind_file
from hil.maintenance.pipeline.reidentify import reidentification
from hil.maintenance.pipeline.stages import kept_document
from hil.maintenance.schedule.ledger import kept, occasion_of
from hil.maintenance.schedule.occasion import Job, Occasion
from hil.models import Registry
from hil.workflow import require_armed, require_extras

STATES = Path("schedules")
"""Where schedules keep their state, a folder each, unless somebody names another."""

BY_HAND = "by-hand"
"""Below the schedule's state: occasions that somebody asked for."""


def run_once(
    path: Path,
    *,
    station: Path | None,
    runs: Path,
    registry: Path,
    state: Path | None,
    campaign: bool,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], object] = lambda text: None,
) -> dict[str, Any]:
    """Probe, and identify anew if that is due; see `hil.api.reidentify`."""
    bound = bind_file(path, station)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    confirm = require_armed(bound.moves(path), state or STATES / bound.spec.name)
    job: Job = "campaign" if campaign or bound.probe is None else "probe"
    home = (state or STATES / bound.spec.name) / BY_HAND
    work = reidentification(
        bound.spec, registry=Registry(registry), runs=runs, station=station,
        observers=observers, confirm=confirm, tell=lambda stage: tell(f"stage: {stage}"),
    )  # fmt: skip
    with kept(home, bound.spec.name):
        occasion = _left(home, job, bound.spec.missed_within)
        if occasion is not None:
            tell(f"going on with {home / occasion.id}")
        occasion = occasion or _new(home, job)
        return dict(work(occasion, home / occasion.id)) | {"folder": str(home / occasion.id)}


def _new(home: Path, job: Job) -> Occasion:
    """One of now; of a later second where that one is taken, or old results were told as new."""
    occasion = Occasion(datetime.now(UTC).replace(microsecond=0), job)
    while (home / occasion.id).exists():
        occasion = Occasion(occasion.due + timedelta(seconds=1), job)
    return occasion


def _left(home: Path, job: Job, within: timedelta) -> Occasion | None:
    """The newest occasion of that kind, if it was cut off; days later the robot is another one."""
    for folder in sorted(home.glob(f"*-{job}"), reverse=True)[:1]:
        left = occasion_of(folder.name)
        if kept_document(folder, "summary") is None and left.due >= datetime.now(UTC) - within:
            return left
    return None
