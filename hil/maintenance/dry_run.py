"""What would happen when, by the loop itself on a clock that is put forward; nothing moves.

How long each occasion moves the robot follows from the plans of what the schedule names.
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
from hil.maintenance.ledger import Job, Ledger, Line, Occasion, ahead, occasion_of, release
from hil.maintenance.scheduler import Scheduler, VirtualClock
from hil.planning import Experiment
from hil.spec import ScheduleSpec
from hil.workflow import preview_experiment


@dataclass(frozen=True, slots=True)
class Expected:
    """Something that would happen.

    Attributes:
        due: When it is due, UTC; of several that are left out, the first.
        job: `probe` or `campaign`.
        what: `done` or `missed`.
        begins: When it would begin, None if it would not.
        motion: How long it would move the robot, were nothing found.
        why: Why it would not begin when it is due, or not at all; empty if it would.
        count: How many are left out for that reason, or follow as regularly as those before.
        again: Whether it was begun before, and is gone on with.
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
        """An entry of `hil schedule plan --json`; times are of the schedule's zone."""
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
    """What would happen if the schedule ran from now on, the robot were free and nothing found.

    One that is held is looked at as if it were released now.

    Args:
        spec: The schedule.
        ledger: As it is now; nothing is written.
        motions: How long its programs move the robot.
        now: When it would be started.
        end: Of the time that is looked at.
        alike: So many probes in a row are told one by one, and those that follow as regularly as
            one entry: a probe every minute is 40320 in four weeks. By default all are.
    """
    clock = VirtualClock(now)
    imagined = Ledger(None, tuple(ledger.lines))
    if imagined.standing.held is not None or ahead(imagined.standing, now):
        release(imagined, now, "")
    known = len(imagined.lines)

    def work(occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        clock.advance(motions.expected(occasion.job))
        return {"outcome": "quiet", "text": ""}

    scheduler = Scheduler(spec, imagined, work, clock, lasting=motions.longest)
    if alike is None or not _is_regular(spec, motions):
        scheduler.run(end)
        return _told(imagined.lines[known:], motions)
    assert spec.probe is not None
    assert spec.probe.every is not None
    while clock.now() < end:
        scheduler.run(min(end, clock.now() + alike * spec.probe.every))
        _skip(spec, scheduler, clock, end)
    return _told(imagined.lines[known:], motions)


def _is_regular(spec: ScheduleSpec, motions: Motions) -> bool:
    """Whether probes between two campaigns are done one like the other, each when it is due."""
    every = spec.probe.every if spec.probe else None
    return every is not None and motions.probe < every and not spec.blackout


_REGULAR = "as regularly as those before"


def _skip(spec: ScheduleSpec, scheduler: Scheduler, clock: VirtualClock, end: datetime) -> None:
    """Go on to the last probe but one before the next campaign, or the end, noting how many."""
    standing, now = scheduler.ledger.standing, clock.now()
    assert standing.anchor is not None
    assert spec.probe is not None
    assert spec.probe.every is not None
    assert standing.until is not None
    start, every = begin_of(spec, standing.anchor), spec.probe.every
    campaign = next(dues(spec.campaign, spec.timezone, start, standing.until), end)
    first = next(dues(spec.probe, spec.timezone, start, standing.until))
    if standing.open is not None or min(first, campaign) <= now:
        return
    count = (min(campaign, end) - first) // every - 1
    if count < 1:
        return
    last = first + (count - 1) * every
    told = {"since": Occasion(first, "probe").id, "occasion": Occasion(last, "probe").id}
    # Nothing is left out; it only settles all of them at once.
    scheduler.ledger.add("missed", now, **told, count=count, why=_REGULAR, until=last.isoformat())
    clock.sleep_until(last)


def _told(lines: list[Line], motions: Motions) -> list[Expected]:
    found, waits = [], ""
    for line in lines:
        if line["event"] == "deferred":
            waits = line["why"]
        elif line["event"] == "missed":
            first = occasion_of(line["since"])
            if line["why"] == _REGULAR:
                long = motions.expected("probe")
                regular = (first.due, "probe", "done", first.due, long, "", line["count"])
                found.append(Expected(*regular))
                continue
            nothing = timedelta()
            told = (first.due, first.job, "missed", None, nothing, line["why"], line["count"])
            found.append(Expected(*told))
        elif line["event"] == "begun":
            one, at = occasion_of(line["occasion"]), datetime.fromisoformat(line["at"])
            long, again = motions.expected(one.job), bool(line.get("again"))
            found.append(Expected(one.due, one.job, "done", at, long, waits, 1, again))
            waits = ""
    return found


ALLOWANCE = 1.1
"""Share of a plan's time that settling and pauses of the controller may add to it."""

AROUND = timedelta(seconds=60)
"""For connecting, preflight and the recording's end, a run."""


@dataclass(frozen=True, slots=True)
class Motions:
    """Motion of the programs of a schedule.

    Attributes:
        probe: Of the short program; zero without one.
        campaign: Of the full program.
        on_drift: Whether a probe may lead to a campaign.
    """

    probe: timedelta = timedelta()
    campaign: timedelta = timedelta()
    on_drift: bool = True

    def expected(self, job: Job) -> timedelta:
        """With nothing found: the probe; or campaign and the probe after it."""
        return self.probe if job == "probe" else self.campaign + 2 * self.probe

    def longest(self, job: Job) -> timedelta:
        """With all that may come of it, and what runs take beside motion."""
        runs = [self.probe]
        if job == "campaign" or self.on_drift:
            runs += [self.campaign, self.probe]
        return sum((ALLOWANCE * each + AROUND for each in runs if each), timedelta())


def motions(spec: ScheduleSpec, probe: Experiment | None, campaign: Experiment) -> Motions:
    """Plan both programs, without connecting to anything.

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
