"""Simulation of a schedule on the embedded mock: weeks at once, by the real loop and the real work.

    FOLDER/runs/ registry/     as of any schedule
    FOLDER/state/              ledger and occasions
    FOLDER/simulation.json     every occasion, with its conditions and its result
    FOLDER/report.html

The clock is put forward to the next due time, and by the duration of each motion. The rest is as on
a real robot, but room temperature, wear and noise are drawn anew for every occasion (`Conditions`).
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
    """The conditions of an occasion.

    Attributes:
        day: Days since the simulation's begin.
        room_c: Temperature of the room [°C].
        wear: Factor on the friction of each joint; empty for a robot as good as new.
    """

    day: int
    room_c: float
    wear: tuple[float, ...]

    @property
    def options(self) -> dict[str, Any]:
        """Options of the mock with these conditions."""
        return {"room_c": self.room_c} | ({"wear": list(self.wear)} if self.wear else {})


def conditions(spec: ScheduleSpec, begin: datetime, occasion: Occasion) -> Conditions:
    """Return the conditions of an occasion; the same whenever they are asked for."""
    since = occasion.due - begin
    room = round(float(_generator(spec, since).uniform(*spec.simulate.room_c)), 1)
    begun = [wear.factors for wear in spec.simulate.wear if wear.after <= since]
    return Conditions(since.days, room, begun[-1] if begun else ())


STAGES = ("probe", "campaign", "check")
"""Runs of an occasion; each has a noise of its own."""

DAYS = 2**31
"""Number of values of the mock's option `day`: so many that hardly two runs share one."""


def noise_day(spec: ScheduleSpec, begin: datetime, occasion: Occasion, stage: str) -> int:
    """Return a value of the mock's option `day`: another one for every run of an occasion."""
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
    """Simulate a schedule for some weeks; see the module.

    Args:
        spec: From `load_schedule_spec`.
        lasting: How long, from its `start`; an occasion that is due at the very end is done.
        folder: Empty folder for everything that is made.
        station: In place of the one the schedule names.
        tell: Called with every line of the ledger.

    Returns:
        The content of `simulation.json`.

    Raises:
        SpecError: A robot is not the embedded mock, or does not have these conditions.
        HilError: No occasion was done, for this reason.
    """
    bound = bind(spec, station)
    require_mock(bound)
    # Whole minutes, as in the ledger: the first occasion is due at the begin, not before it.
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
        loop.run(begin + lasting + timedelta(minutes=1))  # with what is due at the very end
        if loop.failure is not None and not any(line["event"] == "done" for line in ledger.lines):
            raise loop.failure
    document = _document(bound, begin, lasting, times, ledger.lines)
    document["warmth"] = _warmth(folder, bound.name, document["occasions"])
    write_replacing(folder / DOCUMENT, json_document(document))
    return document


@dataclass(frozen=True, slots=True)
class _Adapted:
    """Gives experiments the conditions of their occasion; an `Adapt`."""

    bound: Bound
    begin: datetime
    runs: Path

    def __call__(self, experiment: Experiment, occasion: Occasion, stage: str) -> Experiment:
        options = conditions(self.bound.spec, self.begin, occasion).options
        noise = {"day": noise_day(self.bound.spec, self.begin, occasion, stage)}
        warm = self._warmth_of_campaign(occasion) if stage == "check" else {}
        return with_options(experiment, options | noise | warm)

    def _warmth_of_campaign(self, occasion: Occasion) -> dict[str, float]:
        """Return the arm's temperature after the campaign: the check begins with it."""
        key = f"{self.bound.spec.name}/{occasion.id}/campaign"
        run = run_of(self.runs, self(self.bound.campaign, occasion, "campaign"), key)
        if run is None:
            return {}
        return {"temperature_c": float(np.mean(load_source(run)["temperature"][-1]))}


@dataclass(frozen=True, slots=True)
class _Timed:
    """Work that puts the clock forward by the duration of its motions."""

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
    """Return what warmth does to friction over the probe's motion, by the first champion's law.

    Once from the beginning to the end of the first campaign, once from the coldest moment of all
    runs to the warmest; None if that is not known.
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
    """Return the (N, n) temperatures of the joints [°C]; None if they were not recorded."""
    data = load_source(run)
    return data["temperature"] if "temperature" in data.columns else None


def require_mock(bound: Bound) -> None:
    """Raise if a robot is not the embedded mock, whose time can be put forward, or refuses options.

    Raises:
        SpecError: A robot is another one, or does not have such conditions.
    """
    for experiment in bound.experiments:
        robot, name = experiment.robot, experiment.spec.robot
        if robot.driver != "mock" or robot.options.get("clock", "virtual") != "virtual":
            clock = " in wall time" if robot.driver == "mock" else ""
            raise SpecError(
                f"{name} ({experiment.station_source}) has the driver {robot.driver}{clock}: only "
                "the embedded mock lives through weeks at once",
                hint="name another station with --station",
            )
    simulated = bound.spec.simulate
    for room in simulated.room_c:
        for wear in ((), *(each.factors for each in simulated.wear)):
            met = Conditions(0, room, wear)
            with opened(bound.campaign.spec.robot, with_options(bound.campaign, met.options).robot):
                pass


def with_options(experiment: Experiment, options: Mapping[str, Any]) -> Experiment:
    """Return an experiment with some driver options of its robot changed.

    The station that is copied into the run directory has them, too, so that a resumed run has the
    same robot.

    Args:
        experiment: From `hil.planning.load`.
        options: Laid over those of the station.
    """
    name = experiment.spec.robot
    robot = experiment.robot.model_copy(update={"options": {**experiment.robot.options, **options}})
    station = experiment.station.model_copy(
        update={"robots": {**experiment.station.robots, name: robot}}
    )
    text = station.as_text(experiment.station_source)
    return replace(experiment, robot=robot, station=station, station_text=text)
