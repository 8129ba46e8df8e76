"""A schedule's work done once, now, because somebody asked: `hil reidentify`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from hil.core import AnyPath, DataError, path_of
from hil.engine import Observer
from hil.maintenance.pipeline.bound import bind_file
from hil.maintenance.pipeline.reidentify import reidentification
from hil.maintenance.pipeline.stages import kept_document
from hil.maintenance.schedule.ledger import Ledger, kept, occasion_of
from hil.maintenance.schedule.occasion import Job, Occasion
from hil.models import Registry
from hil.workflow import require_armed, require_extras

STATES = Path("schedules")
"""Where schedules keep their state, a folder each, unless somebody names another."""

BY_HAND = "by-hand"
"""Below the schedule's state: occasions that somebody asked for."""


def reidentify(
    schedule: AnyPath,
    *,
    station: AnyPath | None = None,
    runs: AnyPath = "runs",
    registry: AnyPath = "registry",
    state: AnyPath | None = None,
    campaign: bool = False,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], object] | None = None,
) -> dict[str, Any]:
    """Do once, now, what a schedule is about; goes on with what was cut off not too long ago.

    Args:
        schedule: Its file.
        station: In place of the one it names.
        runs: Where run directories are kept.
        registry: Where the champion is, and challengers go.
        state: Folder of the schedule; by default `schedules/NAME`.
        campaign: Run the full program whatever the probe says.
        observers: Receive progress events of the runs, each on its own thread.
        tell: Told what is begun, in a few words.

    Returns:
        `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`, `champion`, `before`,
        `challenger`, `drift`, `decision`, `errors`, `runs`, `folder`: see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        DataError: Another process does the same now, or the schedule is held.
        HilError: What keeps a stage from its end; the next call goes on there.
    """
    file, at = path_of(schedule), path_of(station) if station else None
    bound = bind_file(file, at)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    of_schedule = path_of(state) if state else STATES / bound.spec.name
    confirm = require_armed(bound.moves(file), of_schedule)
    if held := Ledger.read(of_schedule).standing.held:
        raise DataError(
            f"the schedule {bound.spec.name} is held: {held['why']}",
            hint=f"when the reason is gone: hil schedule release {file} --reason TEXT",
        )
    job: Job = "campaign" if campaign or bound.probe is None else "probe"
    home = of_schedule / BY_HAND
    report = tell or (lambda text: None)
    work = reidentification(
        bound.spec, registry=Registry(path_of(registry)), runs=path_of(runs), station=at,
        observers=observers, confirm=confirm, tell=lambda stage: report(f"stage: {stage}"),
    )  # fmt: skip
    with kept(home, bound.spec.name):
        occasion = _left(home, job, bound.spec.missed_within)
        if occasion is not None:
            report(f"going on with {home / occasion.id}")
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
