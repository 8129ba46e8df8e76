"""A schedule with the experiments it names, checked: what could only fail at night fails now."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hil.campaign.driver_check import check_driver
from hil.campaign.experiment import Experiment, load_experiment
from hil.drift.features import BLOCK_S, FEWEST_BLOCKS
from hil.errors import PluginError, SpecError
from hil.identify.base import HONEST, estimator
from hil.spec.experiment import ExperimentSpec, Fit, Fourier
from hil.spec.schedule import ScheduleSpec, load_schedule_spec
from hil.spec.source import Path as SourcePath
from hil.spec.source import Problem, Source, dotted
from hil.spec.yaml_source import read_source

Finding = tuple[SourcePath, str]
"""Where in the schedule, and what is wrong there."""


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

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """Those there are."""
        return (self.campaign,) if self.probe is None else (self.probe, self.campaign)


def bind(spec: ScheduleSpec, station: Path | None = None, file: Path | None = None) -> Bound:
    """Load what a schedule names, and check that it fits together.

    Args:
        spec: From `load_schedule_spec`.
        station: In place of the one it names.
        file: The schedule's own, for messages.

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
        found = _problems(spec, loaded["campaign"], loaded.get("probe"))
        source = read_source(file) if file is not None else None
        problems += [_line(source, place, message) for place, message in found]
    if problems:
        raise SpecError("\n".join(dict.fromkeys(problems)), hint=hint)
    campaign = loaded["campaign"]
    fit = next(_wanted(spec, campaign.spec))
    name = spec.model or campaign.spec.robot
    return Bound(spec, name, loaded.get("probe"), campaign, fit)


def bind_file(file: Path, station: Path | None = None) -> Bound:
    """A schedule's file bound to all that it names, drivers included.

    Args:
        file: The schedule (YAML).
        station: In place of the one it names.

    Raises:
        SpecError: With a line for every problem of the schedule and of the files it names.
        PluginError: A driver is missing or does not load.
    """
    bound = bind(load_schedule_spec(file), station, file)
    for experiment in bound.experiments:
        check_driver(experiment)
    return bound


def _line(source: Source | None, place: SourcePath, message: str) -> str:
    if source is None:
        return f"{dotted(place)}: {message}"
    return str(Problem(source.mark(place), place, message))


def _problems(
    spec: ScheduleSpec, campaign: Experiment, probe: Experiment | None
) -> Iterator[Finding]:
    yield from _of_the_model(spec, campaign.spec)
    yield from _needs_somebody("campaign", campaign)
    if probe is None:
        return
    yield from _needs_somebody("probe", probe)
    yield from _says_enough(probe.spec)
    robots = probe.spec.robot, campaign.spec.robot
    if robots[0] != robots[1] or probe.robot != campaign.robot:
        yield (
            ("probe", "spec"),
            f"drives {robots[0]} ({probe.station_source}), and the campaign "
            f"{robots[1]} ({campaign.station_source}): a probe tells nothing of another robot",
        )
    if _motion(probe.spec) == _motion(campaign.spec):
        yield (
            ("probe", "spec"),
            "its motion is that of the campaign, so that no model could be judged on "
            "it: give it another excitation.seed",
        )
    if probe.spec.excitation.kind != campaign.spec.excitation.kind:
        yield (
            ("probe", "spec"),
            f"its excitation is {probe.spec.excitation.kind}, that of the campaign "
            f"{campaign.spec.excitation.kind}: the champion could not be compared with it",
        )


def _of_the_model(spec: ScheduleSpec, campaign: ExperimentSpec) -> Iterator[Finding]:
    """What keeps the campaign from having the one model that challenges."""
    names = [fit.estimator for fit in campaign.fit]
    wanted = spec.campaign.estimator
    if not names:
        yield ("campaign", "spec"), f"{campaign.name} has no `fit`: there would be no model"
        return
    if wanted and wanted not in names:
        told = f"{campaign.name} fits {', '.join(names)}, not {wanted!r}"
        yield ("campaign", "estimator"), told
        return
    fits = list(_wanted(spec, campaign))
    if len(fits) > 1:
        told = f"{campaign.name} fits {fits[0].estimator} {len(fits)} times: keep one"
        yield ("campaign", "spec"), told
    with contextlib.suppress(AttributeError):  # some know it only when they are fitted
        protocol = estimator(fits[0].estimator, **fits[0].parameters).protocol
        if protocol != HONEST:
            yield ("campaign", "estimator"), not_honest(fits[0].estimator, protocol)


def not_honest(name: str, protocol: str) -> str:
    """What is wrong with a model that is never judged."""
    return f"the model of {name} is not honest and never judged ({protocol}): name another"


def _wanted(spec: ScheduleSpec, campaign: ExperimentSpec) -> Iterator[Fit]:
    name = spec.campaign.estimator or campaign.fit[0].estimator
    return (fit for fit in campaign.fit if fit.estimator == name)


def _needs_somebody(part: str, experiment: Experiment) -> Iterator[Finding]:
    """Prompts that only a person could answer; a mock on a virtual clock mounts by itself."""
    asked = [load.prompt for load in experiment.spec.loads if load.prompt]
    if not asked:
        return
    try:
        alone = check_driver(experiment).clock == "virtual"
    except (SpecError, PluginError):
        return  # told where drivers are checked
    if not alone:
        yield (
            (part, "spec"),
            f"{experiment.spec.name} asks for something to be done "
            f"({asked[0]!r}), and nobody attends a schedule",
        )


def _says_enough(probe: ExperimentSpec) -> Iterator[Finding]:
    """What keeps a probe from saying what has changed, as far as the spec tells."""
    program = probe.excitation
    if not isinstance(program, Fourier):
        return
    each_s = program.periods / program.fundamental_hz
    if program.trajectories * max(1, round(each_s / BLOCK_S)) < FEWEST_BLOCKS:
        yield (
            ("probe", "spec"),
            f"{program.trajectories} trajectories of {each_s:g} s say too little: "
            f"make them {FEWEST_BLOCKS * BLOCK_S:g} s together, by more excitation.trajectories",
        )


def _motion(spec: ExperimentSpec) -> dict[str, object]:
    return spec.excitation.model_dump(exclude={"trajectories", "waypoints"})
