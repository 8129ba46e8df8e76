"""What is done when a schedule is due: probe, and identify the robot again if it has changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from hil.engine import Observer
from hil.maintenance.pipeline.bound import Bound, bind
from hil.maintenance.pipeline.due import Adapt, Due
from hil.maintenance.pipeline.measuring import Measuring
from hil.maintenance.pipeline.stages import Document, run_stages
from hil.maintenance.schedule.occasion import Occasion, Work
from hil.models import Registry
from hil.planning import Experiment
from hil.spec import ScheduleSpec
from hil.workflow import Confirm, Unconfirmed


def as_it_is(experiment: Experiment, occasion: Occasion, stage: str) -> Experiment:
    """The same on every occasion."""
    return experiment


def reidentification(
    spec: ScheduleSpec,
    *,
    registry: Registry,
    runs: Path,
    station: Path | None = None,
    adapt: Adapt = as_it_is,
    observers: Sequence[Observer] = (),
    confirm: Confirm | None = None,
    tell: Callable[[str], object] = lambda stage: None,
) -> Work:
    """The work of a schedule.

    Args:
        spec: From `load_schedule_spec`.
        registry: Where the champion is, and challengers go.
        runs: Where run directories are kept.
        station: In place of the one the schedule names.
        adapt: Changes an experiment for an occasion, for simulations; see `with_options`.
        observers: Receive progress events of the runs.
        confirm: Confirms that a real robot may move; by default it may not.
        tell: Told the name of every stage that has something to do, when it begins.

    Returns:
        A `Work`. Its document has `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`,
        `champion` and `before` (labels of versions, or null), `challenger`, `drift`, `decision`,
        `errors` and `runs`; see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        PluginError: A driver is missing or does not load.
    """
    wait_s, may_move = spec.wait_for_robot.total_seconds(), confirm or Unconfirmed()
    measuring = Measuring(runs, wait_s, tuple(observers), confirm=may_move)
    return Reidentification(bind(spec, station), registry, measuring, adapt, tell)


@dataclass(frozen=True, slots=True)
class Reidentification:
    """The work of a bound schedule; see `reidentification`.

    Attributes:
        bound: The schedule and its experiments.
        registry: Where models are.
        measuring: How runs are made.
        adapt: Changes an experiment for an occasion.
        tell: Told the name of every stage that has something to do, when it begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    tell: Callable[[str], object]

    def __call__(self, occasion: Occasion, folder: Path) -> Document:
        """Do what is due, or what is left of it; see `hil.maintenance.schedule.occasion.Work`."""
        due = Due(self.bound, self.registry, self.measuring, self.adapt, occasion, self.tell)
        return run_stages(due.stages(), folder)["summary"]
