"""A schedule with the experiments it names, checked: what could only fail at night fails now."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hil.core import KeyPath, Problem, Source, SpecError, dotted, read_source
from hil.maintenance.pipeline.fitting_together import problems as problems_of
from hil.maintenance.pipeline.fitting_together import wanted
from hil.planning import Experiment
from hil.planning import load as load_experiment
from hil.spec import Fit, ScheduleSpec, load_schedule_spec
from hil.workflow import Moves, check_driver


@dataclass(frozen=True, slots=True)
class Bound:
    """A schedule bound to its experiments and their station.

    Attributes:
        spec: What the file says.
        name: Of the models in the registry.
        probe: None where there is none.
        campaign: The full program.
        fit: Entry of the campaign's spec whose model challenges the champion.
    """

    spec: ScheduleSpec
    name: str
    probe: Experiment | None
    campaign: Experiment
    fit: Fit

    def moves(self, file: Path) -> Moves:
        """Return what the schedule in a file moves."""
        parts = {"probe": self.probe, "campaign": self.campaign}
        named = {part: one for part, one in parts.items() if one is not None}
        return Moves(file, self.spec.robots, named)

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """Those there are."""
        return (self.campaign,) if self.probe is None else (self.probe, self.campaign)


def bind(spec: ScheduleSpec, station: Path | None = None, source: Source | None = None) -> Bound:
    """Load what a schedule names, and check that it fits together.

    Args:
        spec: From `load_schedule_spec`.
        station: In place of the one it names.
        source: What was read from its file, for messages.

    Raises:
        SpecError: With a line for every problem of the schedule and of the files it names.
    """
    at = station or (Path(spec.station) if spec.station else None)
    loaded: dict[str, Experiment] = {}
    problems: list[str] = []
    hint = ""
    for part, job in (("probe", spec.probe), ("campaign", spec.campaign)):
        try:
            if job is not None:
                loaded[part] = load_experiment(Path(job.spec), at)
        except SpecError as error:
            problems += error.message.splitlines()
            hint = hint or error.hint
    if "campaign" in loaded:
        found = problems_of(spec, loaded["campaign"], loaded.get("probe"))
        problems += [_line(source, place, message) for place, message in found]
    if problems:
        raise SpecError("\n".join(dict.fromkeys(problems)), hint=hint)
    campaign = loaded["campaign"]
    fit = next(wanted(spec, campaign.spec))
    name = spec.model or campaign.spec.robot
    return Bound(spec, name, loaded.get("probe"), campaign, fit)


def bind_file(file: Path | Source, station: Path | None = None) -> Bound:
    """A schedule's file bound to all that it names, drivers included.

    Args:
        file: The schedule (YAML), or what was read from it.
        station: In place of the one it names.

    Raises:
        SpecError: With a line for every problem of the schedule and of the files it names.
        PluginError: A driver is missing or does not load.
    """
    path = Path(file.name) if isinstance(file, Source) else file
    source = file if isinstance(file, Source) else read_source(file)
    bound = bind(load_schedule_spec(source), station, source)
    for experiment in bound.experiments:
        check_driver(experiment)
    bound.moves(path).real()
    return bound


def _line(source: Source | None, place: KeyPath, message: str) -> str:
    if source is None:
        return f"{dotted(place)}: {message}"
    return str(Problem(source.mark(place), place, message))
