"""Simulation of a schedule over weeks on the embedded mock, with the real loop and real work.

    FOLDER/runs/ registry/     as of any schedule
    FOLDER/state/              ledger and occasions
    FOLDER/simulation.json     every occasion, with its conditions and its result
    FOLDER/report.html

The virtual clock advances to the next due time and by the duration of each motion. A simulation
differs from use on a real robot only in the clock and in room temperature, wear and noise, which
are drawn for every occasion (`Conditions`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FloatArray, SpecError, json_document, write_replacing
from hil.evaluation import usable_part
from hil.importers import load_source
from hil.maintenance.binding import Bound, bind
from hil.maintenance.dry_run import Motions, motions, require_room
from hil.maintenance.due_times import begin_of
from hil.maintenance.ledger import Occasion, Work, occasion_of, open_ledger
from hil.maintenance.reidentifying import reidentification, run_of
from hil.maintenance.scheduler import Line, Scheduler, VirtualClock
from hil.models import Registry, friction_change
from hil.planning import Experiment, opened
from hil.spec import ScheduleSpec

DOCUMENT, PAGE = "simulation.json", "report.html"
FORMAT = 1

WEEK = timedelta(weeks=1)


@dataclass(frozen=True, slots=True)
class Conditions:
    """Simulated conditions of an occasion.

    Attributes:
        day: Number of days since the beginning of the simulation.
        room_c: Room temperature [°C].
        wear: Factor on the friction of each joint; empty for a robot without wear.
    """

    day: int
    room_c: float
    wear: tuple[float, ...]

    @property
    def options(self) -> dict[str, Any]:
        """Driver options of the mock for these conditions."""
        return {"room_c": self.room_c} | ({"wear": list(self.wear)} if self.wear else {})


def conditions(spec: ScheduleSpec, begin: datetime, occasion: Occasion) -> Conditions:
    """Return the simulated conditions of an occasion, which are reproducible."""
    since = occasion.due - begin
    room = round(float(_generator(spec, since).uniform(*spec.simulate.room_c)), 1)
    begun = [wear.factors for wear in spec.simulate.wear if wear.after <= since]
    return Conditions(since.days, room, begun[-1] if begun else ())


STAGES = ("probe", "campaign", "check")
"""Stages of an occasion that have a run; each run has different noise."""

DAYS = 2**31
"""Number of possible values of the mock's option `day`, large enough that two runs rarely have the
same value.
"""


def noise_day(spec: ScheduleSpec, begin: datetime, occasion: Occasion, stage: str) -> int:
    """Return a value of the mock's option `day` that differs for every run of an occasion."""
    generator = _generator(spec, occasion.due - begin, 1 + STAGES.index(stage))
    return int(generator.integers(DAYS))


def _generator(spec: ScheduleSpec, since: timedelta, *more: int) -> np.random.Generator:
    return np.random.default_rng([spec.simulate.seed, int(since.total_seconds()), *more])


def simulate(
    spec: ScheduleSpec,
    lasting: timedelta,
    folder: Path,
    *,
    station: Path | None = None,
    tell: Callable[[Line], object] = lambda line: None,
) -> dict[str, Any]:
    """Simulate a schedule for some weeks, with results as in the module docstring.

    Args:
        spec: Content of the schedule file, from `load_schedule_spec`.
        lasting: Simulated duration; an occasion that is due exactly at the end is done.
        folder: Empty folder for all results of the simulation.
        station: Station file that replaces the station of the schedule; None for the station of the
            schedule.
        tell: Callback that receives every line of the ledger.

    Returns:
        Content of `simulation.json`.

    Raises:
        SpecError: A robot of the schedule is not the embedded mock, or it cannot simulate the
            conditions.
        HilError: No occasion succeeded; the raised error is that of the last occasion.
    """
    bound = bind(spec, station)
    require_mock(bound)
    # Whole minutes, as in the ledger, so that the first occasion is due at the beginning.
    begin = begin_of(spec, datetime.now(UTC).replace(second=0, microsecond=0))
    times = motions(spec, bound.probe, bound.campaign)
    require_room(spec, times, begin)
    clock = VirtualClock(begin)
    work = reidentification(
        spec, registry=Registry(folder / "registry"), runs=folder / "runs", station=station,
        adapt=_Adapted(bound, begin, folder / "runs"),
    )  # fmt: skip
    with open_ledger(folder / "state", spec.name) as ledger:
        timed = _Timed(work, clock, times)
        loop = Scheduler(spec, ledger, timed, clock, lasting=times.longest, tell=tell)
        loop.run(begin + lasting + timedelta(minutes=1))  # include an occasion due at the end
        if loop.failure is not None and not any(line["event"] == "done" for line in ledger.lines):
            raise loop.failure
    document = _document(bound, begin, lasting, times, ledger.lines)
    document["warmth"] = _warmth(folder, bound.name, document["occasions"])
    write_replacing(folder / DOCUMENT, json_document(document))
    return document


@dataclass(frozen=True, slots=True)
class _Adapted:
    """Function that adapts an experiment to the conditions of its occasion; an `Adapt`."""

    bound: Bound
    begin: datetime
    runs: Path

    def __call__(self, experiment: Experiment, occasion: Occasion, stage: str) -> Experiment:
        options = conditions(self.bound.spec, self.begin, occasion).options
        noise = {"day": noise_day(self.bound.spec, self.begin, occasion, stage)}
        warm = self._warmth_of_campaign(occasion) if stage == "check" else {}
        return with_options(experiment, options | noise | warm)

    def _warmth_of_campaign(self, occasion: Occasion) -> dict[str, float]:
        """Return the temperature option of the check: the arm temperature after the campaign."""
        key = f"{self.bound.spec.name}/{occasion.id}/campaign"
        run = run_of(self.runs, self(self.bound.campaign, occasion, "campaign"), key)
        if run is None:
            return {}
        return {"temperature_c": float(np.mean(load_source(run)["temperature"][-1]))}


@dataclass(frozen=True, slots=True)
class _Timed:
    """Work that advances the virtual clock by the duration of its motions."""

    work: Work
    clock: VirtualClock
    times: Motions

    def __call__(self, occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        result = self.work(occasion, folder)
        for stage in result["runs"]:
            self.clock.advance(self.times.campaign if stage == "campaign" else self.times.probe)
        return result


def _document(
    bound: Bound, begin: datetime, lasting: timedelta, times: Motions, ledger: Sequence[Line]
) -> dict[str, Any]:
    spec = bound.spec
    lines = [line for line in ledger if line["event"] in ("done", "failed", "missed")]
    return {
        "hil_simulation": FORMAT,
        "name": spec.name,
        "description": spec.description,
        "model": bound.name,
        "begin": begin.isoformat(),
        "weeks": lasting / WEEK,
        "false_alarm": spec.false_alarm,
        "probe_s": times.probe.total_seconds(),
        "warm_up_s": bound.probe.spec.warm_up.duration_s if bound.probe else 0.0,
        "campaign_s": times.campaign.total_seconds(),
        "simulate": spec.simulate.model_dump(mode="json"),
        "wear_weeks": [each.after / WEEK for each in spec.simulate.wear],
        "occasions": [_occasion_document(spec, begin, line) for line in lines],
    }


def _occasion_document(spec: ScheduleSpec, begin: datetime, line: Line) -> dict[str, Any]:
    occasion = occasion_of(line["occasion"])
    met = conditions(spec, begin, occasion)
    return {
        "id": occasion.id,
        "job": occasion.job,
        "week": (occasion.due - begin) / WEEK,
        "day": met.day,
        "room_c": met.room_c,
        "wear": list(met.wear),
        "event": line["event"],
        "why": line.get("why", ""),
        "result": line.get("result"),
    }


def _warmth(folder: Path, name: str, occasions: Sequence[Mapping[str, Any]]) -> Any:
    """Return the effect of joint temperature on friction over the motion of the probe.

    The effect of temperature on friction is computed with the model of the first champion. The
    returned values are the effect of the temperature change over the first campaign, and the effect
    of the difference between the lowest and the highest temperature of all runs. None is returned
    if the effect of temperature is unknown.
    """
    runs = [each["result"]["runs"] for each in occasions if each["result"]]
    probe = next((each["probe"] for each in runs if "probe" in each), None)
    campaign = next((each["campaign"] for each in runs if "campaign" in each), None)
    celsius = [_temperatures(Path(run)) for each in runs for run in each.values()]
    if probe is None or campaign is None or any(each is None for each in celsius):
        return None
    first = next(each["result"]["champion"] for each in occasions if each["result"])
    model = Registry(folder / "registry").load(name, first)
    data = usable_part(load_source(Path(probe)), model)
    whole = np.concatenate([each for each in celsius if each is not None])
    warming = _temperatures(Path(campaign))
    assert warming is not None
    spans = {"campaign": (warming[0], warming[-1]), "all": (whole.min(axis=0), whole.max(axis=0))}
    return {
        "joint_names": list(model.joint_names_),
        **{
            key: {
                "from_c": cold.tolist(),
                "to_c": warm.tolist(),
                "friction_change": friction_change(model, data, cold, warm).tolist(),
            }
            for key, (cold, warm) in spans.items()
        },
    }


def _temperatures(run: Path) -> FloatArray | None:
    """Return the joint temperatures (N, n) [°C] of a run, or None if they were not recorded."""
    data = load_source(run)
    return data["temperature"] if "temperature" in data.columns else None


def require_mock(bound: Bound) -> None:
    """Raise if a robot is not the embedded mock on a virtual clock, or rejects its options.

    Raises:
        SpecError: A robot of an experiment is not the embedded mock, or it cannot simulate the
            conditions.
    """
    for experiment in bound.experiments:
        robot, name = experiment.robot, experiment.spec.robot
        if robot.driver != "mock" or robot.options.get("clock", "virtual") != "virtual":
            clock = " in wall time" if robot.driver == "mock" else ""
            raise SpecError(
                f"{name} ({experiment.station_source}) has the driver {robot.driver}{clock}: only "
                "the embedded mock on a virtual clock can simulate weeks",
                hint="name another station with --station",
            )
    simulated = bound.spec.simulate
    for room in simulated.room_c:
        for wear in ((), *(each.factors for each in simulated.wear)):
            met = Conditions(0, room, wear)
            with opened(bound.campaign.spec.robot, with_options(bound.campaign, met.options).robot):
                pass


def with_options(experiment: Experiment, options: Mapping[str, Any]) -> Experiment:
    """Return an experiment in which some driver options of the robot are changed.

    The station file in the run directory contains the changed options as well, so a resumed run
    uses the same robot.

    Args:
        experiment: Loaded experiment, from `hil.planning.load`.
        options: Driver options that replace or extend the options in the station.
    """
    name = experiment.spec.robot
    robot = experiment.robot.model_copy(update={"options": {**experiment.robot.options, **options}})
    station = experiment.station.model_copy(
        update={"robots": {**experiment.station.robots, name: robot}}
    )
    text = station.as_text(experiment.station_source)
    return replace(experiment, robot=robot, station=station, station_text=text)
