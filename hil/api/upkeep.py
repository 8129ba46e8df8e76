"""Models that are kept: versions under names, and a schedule's work done once, now."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from hil.api.arguments import AnyPath, path
from hil.engine import Observer

if TYPE_CHECKING:
    from hil.models.registry import Registry


def registry(folder: AnyPath = "registry") -> Registry:
    """Models under names, in versions: who is champion, who was, and why.

    Args:
        folder: Made when something is registered.
    """
    from hil.models.registry import Registry

    return Registry(path(folder))


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
        DataError: Another process does the same now.
        HilError: What keeps a stage from its end; the next call goes on there.
    """
    from hil.maintenance.pipeline.by_hand import run_once

    return run_once(
        path(schedule),
        station=path(station) if station else None,
        runs=path(runs),
        registry=path(registry),
        state=path(state) if state else None,
        campaign=campaign,
        observers=observers,
        tell=tell or (lambda text: None),
    )
