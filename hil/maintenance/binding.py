"""A schedule with the experiments it names, checked: what could only fail at night fails now."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import gcd
from pathlib import Path

from hil.core import KeyPath, PluginError, Problem, Source, SpecError, dotted, read_source
from hil.core import KeyPath as SourcePath
from hil.estimators import HONEST, estimator
from hil.models import BLOCK_S, DRIFT_BLOCK_S, FEWEST_BLOCKS, FEWEST_DRIFT_BLOCKS
from hil.planning import Experiment
from hil.planning import load as load_experiment
from hil.spec import ExperimentSpec, Fit, Fourier, ScheduleSpec, load_schedule_spec
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
        found = mismatches(spec, loaded["campaign"], loaded.get("probe"))
        problems += [_line(source, place, message) for place, message in found]
    if problems:
        raise SpecError("\n".join(dict.fromkeys(problems)), hint=hint)
    campaign = loaded["campaign"]
    fit = next(wanted(spec, campaign.spec))
    name = spec.model or campaign.spec.robot
    return Bound(spec, name, loaded.get("probe"), campaign, fit)


def _line(source: Source | None, place: KeyPath, message: str) -> str:
    if source is None:
        return f"{dotted(place)}: {message}"
    return str(Problem(source.mark(place), place, message))


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


Finding = tuple[SourcePath, str]
"""Where in the schedule, and what is wrong there."""


def mismatches(
    spec: ScheduleSpec, campaign: Experiment, probe: Experiment | None
) -> Iterator[Finding]:
    """Where in a schedule something is wrong, and what.

    Args:
        spec: The schedule.
        campaign: The full program that it names.
        probe: The short one, if it names one.
    """
    yield from _of_the_model(spec, campaign.spec, probed=probe is not None)
    yield from _compares_enough(campaign.spec, None if probe is None else probe.spec)
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


def _of_the_model(
    spec: ScheduleSpec, campaign: ExperimentSpec, *, probed: bool
) -> Iterator[Finding]:
    """What keeps the campaign from having the one model that challenges."""
    names = [fit.estimator for fit in campaign.fit]
    named = spec.campaign.estimator
    if not names:
        yield ("campaign", "spec"), f"{campaign.name} has no `fit`: there would be no model"
        return
    if named and named not in names:
        told = f"{campaign.name} fits {', '.join(names)}, not {named!r}"
        yield ("campaign", "estimator"), told
        return
    fits = list(wanted(spec, campaign))
    if len(fits) > 1:
        told = f"{campaign.name} fits {fits[0].estimator} {len(fits)} times: keep one"
        yield ("campaign", "spec"), told
    model = estimator(fits[0].estimator, **fits[0].parameters)
    protocol = getattr(model, "protocol", HONEST)  # some know it only when they are fitted
    if protocol != HONEST:
        yield ("campaign", "estimator"), not_honest(fits[0].estimator, protocol)
    elif probed and not model.tells_friction:
        told = f"{fits[0].estimator} does not tell friction apart: no probe says what has changed"
        yield ("campaign", "estimator"), f"{told}; name another, or leave the probe out"


def _compares_enough(campaign: ExperimentSpec, probe: ExperimentSpec | None) -> Iterator[Finding]:
    """What keeps a challenger from ever being compared: found at night, after all the motion."""
    program = campaign.excitation
    if not campaign.fit or not isinstance(program, Fourier):
        return
    held = campaign.hold_out
    motions = held.trajectories_of(program.trajectories)
    count = _places(program, motions or program.trajectories)
    if probe is not None and isinstance(probe.excitation, Fourier):
        count += _places(probe.excitation, probe.excitation.trajectories)
    if count < FEWEST_BLOCKS:
        beside = " and the probe" if probe is not None else ""
        yield (
            ("campaign", "spec"),
            f"what {campaign.name} holds out{beside} makes {count} different blocks of "
            f"{BLOCK_S:g} s to compare two models on, and {FEWEST_BLOCKS} are needed: raise "
            "validate.hold_out.trajectories",
        )


def _places(program: Fourier, trajectories: int) -> int:
    """Blocks of a comparison at different places: the next period comes by the same ones."""
    each_s = program.periods / program.fundamental_hz
    count = max(1, round(each_s / BLOCK_S))
    return trajectories * (count // gcd(count, program.periods))


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
    if program.trajectories * max(1, round(each_s / DRIFT_BLOCK_S)) < FEWEST_DRIFT_BLOCKS:
        yield (
            ("probe", "spec"),
            f"{program.trajectories} trajectories of {each_s:g} s say too little: "
            f"make them {FEWEST_DRIFT_BLOCKS * DRIFT_BLOCK_S:g} s together, by more "
            "excitation.trajectories",
        )


def _motion(spec: ExperimentSpec) -> dict[str, object]:
    return spec.excitation.model_dump(exclude={"trajectories", "waypoints"})


def not_honest(name: str, protocol: str) -> str:
    """What is wrong with a model that is never judged."""
    return f"the model of {name} is not honest and never judged ({protocol}): name another"


def wanted(spec: ScheduleSpec, campaign: ExperimentSpec) -> Iterator[Fit]:
    """The campaign's entries whose model challenges; one where nothing is wrong."""
    name = spec.campaign.estimator or campaign.fit[0].estimator
    return (fit for fit in campaign.fit if fit.estimator == name)
