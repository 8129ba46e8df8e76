"""Schedule with its loaded experiments, checked for problems before it runs unattended.

The checks (`mismatches`) detect errors of a schedule that would otherwise appear at night, after
all motion: no model for a challenge, too little data for a comparison of two models, a probe too
short to detect changes, or a prompt that no operator would answer.
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
    """Schedule with its loaded experiments and their station.

    Attributes:
        spec: Content of the schedule file.
        name: Name under which the registry contains the models of the schedule.
        probe: Loaded probe experiment; None if the schedule has no probe.
        campaign: Campaign experiment.
        fit: Entry in the campaign's spec that fits the model which challenges the champion.
    """

    spec: ScheduleSpec
    name: str
    probe: Experiment | None
    campaign: Experiment
    fit: Fit

    def moves(self, file: Path) -> Moves:
        """Return which robots are moved by the schedule in `file`."""
        parts = {"probe": self.probe, "campaign": self.campaign}
        named = {part: one for part, one in parts.items() if one is not None}
        return Moves(file, self.spec.robots, named)

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """Experiments of the schedule: the probe, if there is one, and the campaign."""
        return (self.campaign,) if self.probe is None else (self.probe, self.campaign)


def bind(spec: ScheduleSpec, station: Path | None = None, source: Source | None = None) -> Bound:
    """Load the files named in a schedule and check that they fit together.

    Args:
        spec: Content of the schedule file, from `load_schedule_spec`.
        station: Station file that replaces the station of the schedule; None for the station of the
            schedule.
        source: Parsed schedule file, used for positions in messages.

    Raises:
        SpecError: The schedule or a file named in it has problems; the message has one line per
            problem.
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
    """Return the schedule of a file with its experiments, after checking them and their drivers.

    Args:
        file: Path of the schedule file (YAML), or its parsed content.
        station: Station file that replaces the station of the schedule; None for the station of the
            schedule.

    Raises:
        SpecError: The schedule or a file named in it has problems; the message has one line per
            problem.
        PluginError: A robot driver is missing or cannot be loaded.
    """
    path = Path(file.name) if isinstance(file, Source) else file
    source = file if isinstance(file, Source) else read_source(file)
    bound = bind(load_schedule_spec(source), station, source)
    for experiment in bound.experiments:
        check_driver(experiment)
    bound.moves(path).real()
    return bound


Finding = tuple[KeyPath, str]
"""Position in the schedule file, and description of the problem there."""


def mismatches(
    spec: ScheduleSpec, campaign: Experiment, probe: Experiment | None
) -> Iterator[Finding]:
    """Yield the problems of a schedule, each with its position in the file.

    Args:
        spec: Schedule.
        campaign: Campaign experiment of the schedule.
        probe: Probe experiment of the schedule; None if there is no probe.
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
            f"drives {robots[0]} ({probe.station_source}), but the campaign drives "
            f"{robots[1]} ({campaign.station_source}): both must use the same robot",
        )
    if _motion(probe.spec) == _motion(campaign.spec):
        yield (
            ("probe", "spec"),
            "it has the same motion as the campaign, so that no model could be evaluated on "
            "it: give it a different excitation.seed",
        )
    if probe.spec.excitation.kind != campaign.spec.excitation.kind:
        yield (
            ("probe", "spec"),
            f"its excitation is {probe.spec.excitation.kind}, the excitation of the campaign is "
            f"{campaign.spec.excitation.kind}: both must be of the same kind, so that the probe "
            "can be compared with the champion",
        )


def _without_challenger(
    spec: ScheduleSpec, campaign: ExperimentSpec, *, probed: bool
) -> Iterator[Finding]:
    """Yield the problems if the campaign does not fit exactly one model for the challenge."""
    names = [fit.estimator for fit in campaign.fit]
    named = spec.campaign.estimator
    if not names:
        yield ("campaign", "spec"), f"{campaign.name} has no `fit`, so that it yields no model"
        return
    if named and named not in names:
        message = f"{campaign.name} fits {', '.join(names)}, not {named!r}"
        yield ("campaign", "estimator"), message
        return
    fits = list(challenging_fits(spec, campaign))
    if len(fits) > 1:
        message = (
            f"{campaign.name} fits {fits[0].estimator} {len(fits)} times: keep one of these fits"
        )
        yield ("campaign", "spec"), message
    model = estimator(fits[0].estimator, **fits[0].parameters)
    protocol = getattr(model, "protocol", HONEST)  # unknown before the fit for some estimators
    if protocol != HONEST:
        yield ("campaign", "estimator"), not_honest(fits[0].estimator, protocol)
    elif probed and not model.tells_friction:
        why = (
            f"{fits[0].estimator} does not predict friction separately, so that no probe could "
            "show what has changed"
        )
        yield ("campaign", "estimator"), f"{why}; name another estimator, or remove the probe"


def challenging_fits(spec: ScheduleSpec, campaign: ExperimentSpec) -> Iterator[Fit]:
    """Return the fits of the campaign whose models challenge; a valid schedule has exactly one."""
    name = spec.campaign.estimator or campaign.fit[0].estimator
    return (fit for fit in campaign.fit if fit.estimator == name)


def not_honest(name: str, protocol: str) -> str:
    """Return the problem of an estimator whose model is not fitted under the honest protocol."""
    return (
        f"the model of {name} is not fitted under the honest protocol and is therefore not "
        f"evaluated ({protocol}): name another estimator"
    )


def _too_short_to_compare(
    campaign: ExperimentSpec, probe: ExperimentSpec | None
) -> Iterator[Finding]:
    """Yield a problem if the campaign yields too few blocks to compare champion and challenger."""
    program = campaign.excitation
    if not campaign.fit or not isinstance(program, Fourier):
        return
    # If whole loads are held out, all trajectories under these loads are unseen.
    motions = campaign.hold_out.trajectories_of(program.trajectories)
    count = _places(program, motions or program.trajectories)
    if probe is not None and isinstance(probe.excitation, Fourier):
        count += _places(probe.excitation, probe.excitation.trajectories)
    if count < FEWEST_BLOCKS:
        beside = " and the probe" if probe is not None else ""
        yield (
            ("campaign", "spec"),
            f"the hold-out set of {campaign.name}{beside} contains {count} distinct blocks of "
            f"{BLOCK_S:g} s, but {FEWEST_BLOCKS} are required to compare two models: raise "
            "validate.hold_out.trajectories",
        )


def _places(program: Fourier, trajectories: int) -> int:
    """Return the number of distinct blocks, because further periods may repeat the same blocks."""
    each_s = program.periods / program.fundamental_hz
    count = max(1, round(each_s / BLOCK_S))
    return trajectories * (count // gcd(count, program.periods))


def _needs_operator(part: str, experiment: Experiment) -> Iterator[Finding]:
    """Yield a problem if a prompt needs an operator; a mock on a virtual clock needs none."""
    prompts = [load.prompt for load in experiment.spec.loads if load.prompt]
    if not prompts:
        return
    try:
        answers_itself = check_driver(experiment).clock == "virtual"
    except (SpecError, PluginError):
        return  # reported by the check of the drivers
    if not answers_itself:
        yield (
            (part, "spec"),
            f"{experiment.spec.name} has a prompt ({prompts[0]!r}), but a schedule runs without "
            "an operator",
        )


def _too_short_for_drift(probe: ExperimentSpec) -> Iterator[Finding]:
    """Yield a problem if the probe yields too few blocks to detect changes."""
    program = probe.excitation
    if not isinstance(program, Fourier):
        return
    each_s = program.periods / program.fundamental_hz
    if program.trajectories * max(1, round(each_s / DRIFT_BLOCK_S)) < FEWEST_DRIFT_BLOCKS:
        yield (
            ("probe", "spec"),
            f"{program.trajectories} trajectories of {each_s:g} s are too short to detect a "
            f"change: at least {FEWEST_DRIFT_BLOCKS * DRIFT_BLOCK_S:g} s in total are required; "
            "raise excitation.trajectories",
        )


def _motion(spec: ExperimentSpec) -> dict[str, object]:
    """Return the settings that determine poses and trajectories, except the number of them."""
    return spec.excitation.model_dump(exclude={"trajectories", "waypoints"})
