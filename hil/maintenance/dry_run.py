"""Forecast of a schedule: the loop itself, on a clock that is put forward; nothing moves.

How long each occasion moves the robot follows from the plans of its experiments (`Motions`).
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
    """An occasion that would be done or missed, or several of one kind.

    Attributes:
        due: When it is due, UTC; of several, the first.
        job: `probe` or `campaign`.
        what: `done` or `missed`.
        begins: When it would begin; None if it would not.
        motion: How long it would move the robot if no change is found.
        why: Why it would begin later than it is due, or not at all; empty otherwise.
        count: Number of occasions: left out for the same reason, or as regular as those before.
        again: Whether it was begun before, and is continued.
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
        """Return an entry of `hil schedule plan --json`; times are of the schedule's zone."""
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
    """Return what happens if the schedule runs from now on, the robot is free and has not changed.

    A schedule that is held is treated as if it were released now.

    Args:
        spec: The schedule.
        ledger: As it is now; nothing is written.
        motions: How long its programs move the robot.
        now: When it would be started.
        end: Of the time that is looked at.
        alike: Number of probes in a row that get an entry each; those that follow as regularly are
            one entry, as a probe every minute is 40,320 in four weeks. By default each gets one.
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
    # Probes between two campaigns are alike if each is over before the next is due.
    if alike is None or every is None or motions.probe >= every or spec.blackout:
        scheduler.run(end)
    else:
        while clock.now() < end:
            scheduler.run(min(end, clock.now() + alike * every))
            _skip_regular_probes(spec, every, scheduler, clock, end)
    return _expected(in_memory.lines[known:], motions)


_REGULAR = "as regularly as those before"


def _skip_regular_probes(
    spec: ScheduleSpec,
    every: timedelta,
    scheduler: Scheduler,
    clock: VirtualClock,
    end: datetime,
) -> None:
    """Put the clock forward to the last probe but one before the next campaign, or before the end.

    The ledger gets one line for all the probes in between.
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
    # Nothing is missed: this event is the one that settles many occasions at once.
    scheduler.ledger.add("missed", now, **which, count=count, why=_REGULAR, until=last.isoformat())
    clock.sleep_until(last)


def _expected(lines: list[Line], motions: Motions) -> list[Expected]:
    """Return what the lines of a ledger say that happens."""
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
"""Factor on the time of a plan, for settling and for pauses of the controller."""

AROUND = timedelta(seconds=60)
"""Time per run for connecting, preflight and the end of the recording."""


@dataclass(frozen=True, slots=True)
class Motions:
    """How long the programs of a schedule move the robot.

    Attributes:
        probe: Time of the short program; zero without one.
        campaign: Time of the full program.
        on_drift: Whether a probe may lead to a campaign.
    """

    probe: timedelta = timedelta()
    campaign: timedelta = timedelta()
    on_drift: bool = True

    def expected(self, job: Job) -> timedelta:
        """Return the time of motion without a change; a campaign has a probe on either side."""
        return self.probe if job == "probe" else self.campaign + 2 * self.probe

    def longest(self, job: Job) -> timedelta:
        """Return the longest time of an occasion, with what runs take beside motion."""
        runs = [self.probe]
        if job == "campaign" or self.on_drift:
            runs += [self.campaign, self.probe]
        return sum((ALLOWANCE * each + AROUND for each in runs if each), timedelta())


def motions(spec: ScheduleSpec, probe: Experiment | None, campaign: Experiment) -> Motions:
    """Plan both programs, without connecting to anything, and return how long they move the robot.

    Raises:
        PlanError: No safe plan follows from one of them.
    """
    short, full = (
        timedelta(seconds=round(preview_experiment(each)[1].duration_s)) if each else timedelta()
        for each in (probe, campaign)
    )
    return Motions(short, full, spec.campaign.on_drift)


def require_room(spec: ScheduleSpec, motions: Motions, now: datetime) -> None:
    """Refuse a schedule whose blackouts leave no room for what it does.

    Raises:
        SpecError: They do not.
    """
    jobs: tuple[Job, ...] = ("campaign",) if spec.probe is None else ("probe", "campaign")
    for job in jobs:
        longest = motions.longest(job)
        if next_free(spec, now, longest)[0] is None:
            raise SpecError(
                f"blackout: a {job}, with all that may come of it, takes up to "
                f"{duration_text(longest)}, and there is never so much time between blackouts",
                hint="make the programs shorter, or the blackouts",
            )
