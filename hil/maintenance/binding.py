"""A schedule bound to the experiments it names, and checked against them.

A schedule runs unattended. What would fail only at night, after all the motion, is found here: no
model to challenge with, too little data to compare two models on, a probe that says too little, or
a prompt that nobody would answer (`mismatches`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import gcd
from pathlib import Path

from hil.core import KeyPath, PluginError, Problem, Source, SpecError, dotted, read_source
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
        probe: The short program; None without one.
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
        """The experiments of the schedule."""
        return (self.campaign,) if self.probe is None else (self.probe, self.campaign)


def bind(spec: ScheduleSpec, station: Path | None = None, source: Source | None = None) -> Bound:
    """Load what a schedule names, check that it fits together, and return it.

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
        findings = mismatches(spec, loaded["campaign"], loaded.get("probe"))
        problems += [_line(source, place, message) for place, message in findings]
    if problems:
        raise SpecError("\n".join(dict.fromkeys(problems)), hint=hint)
    campaign = loaded["campaign"]
    fit = next(challenging_fits(spec, campaign.spec))
    name = spec.model or campaign.spec.robot
    return Bound(spec, name, loaded.get("probe"), campaign, fit)


def _line(source: Source | None, place: KeyPath, message: str) -> str:
    if source is None:
        return f"{dotted(place)}: {message}"
    return str(Problem(source.mark(place), place, message))


def bind_file(file: Path | Source, station: Path | None = None) -> Bound:
    """Return the schedule of a file, bound to all that it names and checked, drivers included.

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


Finding = tuple[KeyPath, str]
"""Where in the schedule, and what is wrong there."""


def mismatches(
    spec: ScheduleSpec, campaign: Experiment, probe: Experiment | None
) -> Iterator[Finding]:
    """Yield what is wrong with a schedule, and where.

    Args:
        spec: The schedule.
        campaign: The full program that it names.
        probe: The short one, if it names one.
    """
    yield from _without_challenger(spec, campaign.spec, probed=probe is not None)
    yield from _too_short_to_compare(campaign.spec, None if probe is None else probe.spec)
    yield from _needs_operator("campaign", campaign)
    if probe is None:
        return
    yield from _needs_operator("probe", probe)
    yield from _too_short_for_drift(probe.spec)
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


def _without_challenger(
    spec: ScheduleSpec, campaign: ExperimentSpec, *, probed: bool
) -> Iterator[Finding]:
    """Yield what keeps the campaign from having just one model that may challenge."""
    names = [fit.estimator for fit in campaign.fit]
    named = spec.campaign.estimator
    if not names:
        yield ("campaign", "spec"), f"{campaign.name} has no `fit`: there would be no model"
        return
    if named and named not in names:
        message = f"{campaign.name} fits {', '.join(names)}, not {named!r}"
        yield ("campaign", "estimator"), message
        return
    fits = list(challenging_fits(spec, campaign))
    if len(fits) > 1:
        message = f"{campaign.name} fits {fits[0].estimator} {len(fits)} times: keep one"
        yield ("campaign", "spec"), message
    model = estimator(fits[0].estimator, **fits[0].parameters)
    protocol = getattr(model, "protocol", HONEST)  # some know it only when they are fitted
    if protocol != HONEST:
        yield ("campaign", "estimator"), not_honest(fits[0].estimator, protocol)
    elif probed and not model.tells_friction:
        why = f"{fits[0].estimator} does not tell friction apart: no probe says what has changed"
        yield ("campaign", "estimator"), f"{why}; name another, or leave the probe out"


def challenging_fits(spec: ScheduleSpec, campaign: ExperimentSpec) -> Iterator[Fit]:
    """Return the campaign's fits whose model challenges; just one if nothing is wrong."""
    name = spec.campaign.estimator or campaign.fit[0].estimator
    return (fit for fit in campaign.fit if fit.estimator == name)


def not_honest(name: str, protocol: str) -> str:
    """Return what is wrong with an estimator whose model is never judged."""
    return f"the model of {name} is not honest and never judged ({protocol}): name another"


def _too_short_to_compare(
    campaign: ExperimentSpec, probe: ExperimentSpec | None
) -> Iterator[Finding]:
    """Yield what keeps champion and challenger from ever being compared: too few blocks."""
    program = campaign.excitation
    if not campaign.fit or not isinstance(program, Fourier):
        return
    # If whole loads are held out, no trajectory is: all of them are unseen under these loads.
    motions = campaign.hold_out.trajectories_of(program.trajectories)
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
    """Return the number of blocks at different places: the next period comes by the same ones."""
    each_s = program.periods / program.fundamental_hz
    count = max(1, round(each_s / BLOCK_S))
    return trajectories * (count // gcd(count, program.periods))


def _needs_operator(part: str, experiment: Experiment) -> Iterator[Finding]:
    """Yield a prompt that needs an operator; a mock on a virtual clock answers by itself."""
    prompts = [load.prompt for load in experiment.spec.loads if load.prompt]
    if not prompts:
        return
    try:
        answers_itself = check_driver(experiment).clock == "virtual"
    except (SpecError, PluginError):
        return  # reported where drivers are checked
    if not answers_itself:
        yield (
            (part, "spec"),
            f"{experiment.spec.name} asks for something to be done "
            f"({prompts[0]!r}), and nobody attends a schedule",
        )


def _too_short_for_drift(probe: ExperimentSpec) -> Iterator[Finding]:
    """Yield what keeps a probe from saying what has changed: too few blocks."""
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
    """Return what decides the poses and trajectories of a program, but for their number."""
    return spec.excitation.model_dump(exclude={"trajectories", "waypoints"})
