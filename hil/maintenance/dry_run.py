"""Forecast of a schedule: the scheduler loop on a virtual clock, without any motion.

The motion time of each occasion is computed from the plans of its experiments (`Motions`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from hil.core import SpecError, duration_text
from hil.maintenance.due_times import begin_of, dues, next_free
from hil.maintenance.ledger import Job, Ledger, Line, Occasion, clock_problem, occasion_of, release
from hil.maintenance.scheduler import Scheduler, VirtualClock
from hil.planning import Experiment
from hil.spec import ScheduleSpec
from hil.workflow import preview_experiment


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected occasion of a schedule, done or missed, or several occasions of the same kind.

    Attributes:
        due: Due time, UTC; for several occasions, the due time of the first.
        job: Job of the occasion, `probe` or `campaign`.
        what: Expected outcome, `done` or `missed`.
        begins: Time at which the occasion would begin; None if it would not begin.
        motion: Motion time of the occasion if no change is detected.
        why: Reason why the occasion begins late or does not begin; empty otherwise.
        count: Number of occasions that are omitted for the same reason or follow at regular
            intervals.
        again: Flag; true if the occasion was begun earlier and is continued.
    """

    due: datetime
    job: str
    what: str
    begins: datetime | None
    motion: timedelta
    why: str = ""
    count: int = 1
    again: bool = False

    def to_dict(self, zone: ZoneInfo) -> dict[str, Any]:
        """Return the entry in `hil schedule plan --json`; times are in the schedule's time zone."""
        return {
            "due": self.due.astimezone(zone).isoformat(timespec="seconds"),
            "job": self.job,
            "what": self.what,
            "begins": self.begins and self.begins.astimezone(zone).isoformat(timespec="seconds"),
            "motion": duration_text(self.motion),
            "why": self.why,
            "count": self.count,
            "again": self.again,
        }


def forecast(
    spec: ScheduleSpec,
    ledger: Ledger,
    motions: Motions,
    now: datetime,
    end: datetime,
    *,
    alike: int | None = None,
) -> list[Expected]:
    """Return the expected occasions from now on, if the robot does not change.

    The forecast assumes that the robot is free. The forecast treats a held schedule as if it were
    released now.

    Args:
        spec: Schedule.
        ledger: Current ledger of the schedule, which is not modified.
        motions: Motion times of the probe and the campaign.
        now: Time at which the schedule would be started.
        end: Time at which the forecast ends.
        alike: Number of consecutive probes that get separate entries. Further regular probes share
            one entry, because a probe every minute would give 40,320 entries in four weeks. Without
            `alike`, each probe has a separate entry.
    """
    clock = VirtualClock(now)
    in_memory = Ledger(None, tuple(ledger.lines))
    if in_memory.standing.held is not None or clock_problem(in_memory.standing, now):
        release(in_memory, now, "")
    known = len(in_memory.lines)

    def work(occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        clock.advance(motions.expected(occasion.job))
        return {"outcome": "quiet", "text": ""}

    scheduler = Scheduler(spec, in_memory, work, clock, lasting=motions.longest)
    every = spec.probe.every if spec.probe else None
    # Probes between two campaigns are regular if each ends before the next is due.
    if alike is None or every is None or motions.probe >= every or spec.blackout:
        scheduler.run(end)
    else:
        while clock.now() < end:
            scheduler.run(min(end, clock.now() + alike * every))
            _skip_regular_probes(spec, every, scheduler, clock, end)
    return _expected(in_memory.lines[known:], motions)


_REGULAR = "at the same interval as before"


def _skip_regular_probes(
    spec: ScheduleSpec,
    every: timedelta,
    scheduler: Scheduler,
    clock: VirtualClock,
    end: datetime,
) -> None:
    """Advance the clock to the last probe but one before the next campaign, or before `end`.

    The ledger gets a single line for all skipped probes.
    """
    standing, now = scheduler.ledger.standing, clock.now()
    assert standing.anchor is not None
    assert spec.probe is not None
    assert standing.until is not None
    start = begin_of(spec, standing.anchor)
    campaign = next(dues(spec.campaign, spec.timezone, start, standing.until), end)
    first = next(dues(spec.probe, spec.timezone, start, standing.until))
    if standing.open is not None or min(first, campaign) <= now:
        return
    count = (min(campaign, end) - first) // every - 1
    if count < 1:
        return
    last = first + (count - 1) * every
    which = {"since": Occasion(first, "probe").id, "occasion": Occasion(last, "probe").id}
    # No occasion is missed here, but only this event settles many occasions at once.
    scheduler.ledger.add("missed", now, **which, count=count, why=_REGULAR, until=last.isoformat())
    clock.sleep_until(last)


def _expected(lines: list[Line], motions: Motions) -> list[Expected]:
    """Return the expected occasions that the lines of a ledger describe."""
    expected: list[Expected] = []
    waits = ""
    for line in lines:
        if line["event"] == "deferred":
            waits = line["why"]
        elif line["event"] == "missed":
            first, count = occasion_of(line["since"]), line["count"]
            if line["why"] == _REGULAR:
                motion = motions.expected("probe")
                entry = Expected(first.due, "probe", "done", first.due, motion, count=count)
            else:
                entry = Expected(
                    first.due, first.job, "missed", None, timedelta(), line["why"], count
                )
            expected.append(entry)
        elif line["event"] == "begun":
            one, at = occasion_of(line["occasion"]), datetime.fromisoformat(line["at"])
            motion, again = motions.expected(one.job), bool(line.get("again"))
            expected.append(Expected(one.due, one.job, "done", at, motion, waits, 1, again))
            waits = ""
    return expected


ALLOWANCE = 1.1
"""Factor on the planned motion time, which covers settling and pauses of the controller."""

AROUND = timedelta(seconds=60)
"""Additional time per run, for connecting, preflight and the end of the recording."""


@dataclass(frozen=True, slots=True)
class Motions:
    """Motion times of the two programs of a schedule: probe and campaign.

    Attributes:
        probe: Motion time of the probe; zero if the schedule has no probe.
        campaign: Motion time of the campaign.
        on_drift: Flag; true if a detected change leads to a campaign.
    """

    probe: timedelta = timedelta()
    campaign: timedelta = timedelta()
    on_drift: bool = True

    def expected(self, job: Job) -> timedelta:
        """Return the motion time of an occasion if no change is detected.

        A campaign includes a probe before and a probe after it.
        """
        return self.probe if job == "probe" else self.campaign + 2 * self.probe

    def longest(self, job: Job) -> timedelta:
        """Return the longest duration of an occasion, including the overhead of its runs."""
        runs = [self.probe]
        if job == "campaign" or self.on_drift:
            runs += [self.campaign, self.probe]
        return sum((ALLOWANCE * each + AROUND for each in runs if each), timedelta())


def motions(spec: ScheduleSpec, probe: Experiment | None, campaign: Experiment) -> Motions:
    """Plan probe and campaign without a connection to the robot, and return their motion times.

    Raises:
        PlanError: The probe or the campaign has no safe plan.
    """
    short, full = (
        timedelta(seconds=round(preview_experiment(each)[1].duration_s)) if each else timedelta()
        for each in (probe, campaign)
    )
    return Motions(short, full, spec.campaign.on_drift)


def require_room(spec: ScheduleSpec, motions: Motions, now: datetime) -> None:
    """Raise if the blackouts of a schedule leave too little time for its occasions.

    Raises:
        SpecError: The time between two blackouts is too short.
    """
    jobs: tuple[Job, ...] = ("campaign",) if spec.probe is None else ("probe", "campaign")
    for job in jobs:
        longest = motions.longest(job)
        if next_free(spec, now, longest)[0] is None:
            raise SpecError(
                f"blackout: a {job}, including the runs that may follow it, takes up to "
                f"{duration_text(longest)}, which is longer than the time between blackouts",
                hint="shorten the programs or the blackouts",
            )
