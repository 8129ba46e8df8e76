"""What is due when, and which of it is done; pure functions of schedule, ledger and clock.

Times of day are those of the schedule's time zone. One that the clock skips (when summer time
begins) comes at the moment it skips; one that it shows twice comes the first time. Intervals are of
true time. Everything that comes out is UTC.

What was begun is gone on with first. Of what else is due one occasion is done: the latest campaign,
or where none is due the latest probe; the others are left out in its favour, since a robot that is
looked at once need not be looked at twice. What was due too long ago is left out, too.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from functools import cache, lru_cache
from itertools import groupby, takewhile
from typing import Any
from zoneinfo import ZoneInfo

from hil.core import duration_text
from hil.maintenance.ledger import Job, Occasion, Standing
from hil.spec import Blackout, ScheduleSpec, Trigger


def occasions(spec: ScheduleSpec, anchor: datetime, after: datetime) -> Iterator[Occasion]:
    """What is due, in order; where probe and campaign are due together, the campaign alone.

    Args:
        spec: The schedule.
        anchor: The minute of its first start: nothing before that is due, and intervals count from
            it unless the schedule says from when.
        after: Only what is due later.
    """
    after = max(after, anchor - timedelta(seconds=1))
    start = begin_of(spec, anchor)
    triggers: list[tuple[Job, Trigger]] = [("campaign", spec.campaign)]
    if spec.probe is not None:
        triggers.append(("probe", spec.probe))
    streams = (_of(job, dues(trigger, spec.timezone, start, after)) for job, trigger in triggers)
    # Of what is due at the same time the campaign sorts first.
    for _, together in groupby(heapq.merge(*streams), key=lambda each: each.due):
        yield next(together)


def _of(job: Job, times: Iterator[datetime]) -> Iterator[Occasion]:
    return (Occasion(due, job) for due in times)


def begin_of(spec: ScheduleSpec, anchor: datetime) -> datetime:
    """From when intervals count, UTC: the schedule's `start`, else when it was first started."""
    if spec.start is None:
        return anchor.astimezone(UTC)
    if spec.start.tzinfo is None:
        return moment_of(spec.start, ZoneInfo(spec.timezone))
    return spec.start.astimezone(UTC)


def dues(trigger: Trigger, timezone: str, start: datetime, after: datetime) -> Iterator[datetime]:
    """Due times later than `after`, UTC; without end, unless the calendar has one.

    Args:
        trigger: Every so often, by the calendar, or never.
        timezone: Of the calendar.
        start: From when intervals count; it is a due time itself.
        after: Only what is due later.
    """
    if trigger.every is not None:
        yield from _intervals(trigger.every, start, after)
    elif trigger.cron is not None:
        yield from _by_calendar(trigger.cron, ZoneInfo(timezone), after)


def _intervals(every: timedelta, start: datetime, after: datetime) -> Iterator[datetime]:
    count = max(0, (after - start) // every)
    while True:
        try:
            # In whole seconds, as the ledger has them.
            due = (start + count * every).replace(microsecond=0)
        except OverflowError:
            return
        if due > after:
            yield due
        count += 1


_MINUTE, _DAY = timedelta(minutes=1), timedelta(days=1)


def _by_calendar(cron: str, zone: ZoneInfo, after: datetime) -> Iterator[datetime]:
    # What the wall shows then was shown at `after` or before; later times of day come later.
    shown = after.astimezone(zone).replace(tzinfo=None)
    wall, before = shown.replace(second=0, microsecond=0), after
    while (found := _shown_next(cron, zone, wall)) is not None:
        wall, due = found[0] + _MINUTE, found[1]
        if due > before:
            yield due
            before = due


@lru_cache(maxsize=1024)  # the loop asks for the same minutes again and again
def _shown_next(cron: str, zone: ZoneInfo, wall: datetime) -> tuple[datetime, datetime] | None:
    """The first due time from then on: as the wall shows it, and UTC."""
    found = _calendar(cron).get_next_fire_time(None, wall.replace(tzinfo=UTC))
    if found is None:
        return None
    shown = found.replace(tzinfo=None)
    return shown, moment_of(shown, zone)


@cache
def _calendar(cron: str) -> Any:
    """It is walked as if it were UTC's: where clocks are never put forward or back."""
    from apscheduler.triggers.cron import CronTrigger

    return CronTrigger.from_crontab(cron, timezone=UTC)


def moment_of(wall: datetime, zone: ZoneInfo, *, last: bool = False) -> datetime:
    """When a clock on the wall shows a time, UTC.

    Args:
        wall: Without a time zone.
        zone: Of the clock.
        last: Of a time that it shows twice, the second.
    """
    shown = wall.replace(tzinfo=zone, fold=int(last))
    moment = shown.astimezone(UTC)
    if moment.astimezone(zone).replace(tzinfo=None, fold=0) == wall:
        return moment
    # Skipped: by the rule of before it comes after the clock is put forward, by the new one before.
    late, early = (wall.replace(tzinfo=zone, fold=fold).astimezone(UTC) for fold in (0, 1))
    while late - early > timedelta(seconds=1):
        middle = early + (late - early) // 2
        if middle.astimezone(zone).replace(tzinfo=None) > wall:
            late = middle
        else:
            early = middle
    return late.replace(microsecond=0)


@dataclass(frozen=True, slots=True)
class Window:
    """A time in which nothing may be done.

    Attributes:
        begin, end: UTC; the end is free again.
        why: What the schedule says, else when it is.
    """

    begin: datetime
    end: datetime
    why: str


def next_free(
    spec: ScheduleSpec, moment: datetime, lasting: timedelta
) -> tuple[datetime | None, Window | None]:
    """When something may begin that takes so long, and what keeps it from beginning now.

    Args:
        spec: The schedule.
        moment: Not before that.
        lasting: It must end before the next blackout.

    Returns:
        The first moment, UTC, or None where it fits nowhere between blackouts; and the first
        blackout in its way, None where it may begin at once.
    """
    lasting = max(lasting, timedelta(seconds=1))
    free, first = moment.astimezone(UTC), None
    hopeless = _settled_by(spec, free) + lasting
    while (window := window_in(spec, free, free + lasting)) is not None:
        first = first or window
        free = window.end
        if free > hopeless:
            return None, first
    return free, first


def _settled_by(spec: ScheduleSpec, moment: datetime) -> datetime:
    """After this every week has the same blackouts, and two of them have been seen."""
    days = [day for one in spec.blackout for day in (one.first, one.last) if day]
    latest = max([moment, *(datetime.combine(day, time(), UTC) for day in days)])
    return latest + 16 * _DAY


def window_in(spec: ScheduleSpec, begin: datetime, end: datetime) -> Window | None:
    """The blackout that begins first of those with some part in `begin` … `end`, None if none."""
    zone = ZoneInfo(spec.timezone)
    day, last = begin.astimezone(zone).date() - 2 * _DAY, end.astimezone(zone).date()
    found: list[Window] = []
    while day <= last and not found:
        windows = (_window(one, day, zone) for one in spec.blackout if _holds_on(one, day))
        found = [each for each in windows if each.begin < end and begin < each.end]
        day += _DAY
    return min(found, key=lambda window: window.begin, default=None)


def _window(blackout: Blackout, day: date, zone: ZoneInfo) -> Window:
    midnight = datetime.combine(day, time())
    begin, end = _time_of_day(blackout.begin), _time_of_day(blackout.end)
    end += _DAY if end <= begin else timedelta()
    span = f"{blackout.begin} to {blackout.end}"
    if (blackout.begin, blackout.end) == ("00:00", "24:00") and blackout.first and blackout.last:
        span = f"{blackout.first} to {blackout.last}"
    return Window(
        moment_of(midnight + begin, zone),
        moment_of(midnight + end, zone, last=True),
        f"blackout {span}" + (f" ({blackout.why})" if blackout.why else ""),
    )


def _time_of_day(text: str) -> timedelta:
    hours, minutes = text.split(":")
    return timedelta(hours=int(hours), minutes=int(minutes))


_DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


def _holds_on(blackout: Blackout, day: date) -> bool:
    """Whether it begins on that day."""
    in_season = (blackout.first or day) <= day <= (blackout.last or day)
    return in_season and (not blackout.days or _DAYS[day.weekday()] in blackout.days)


PUNCTUAL = timedelta(minutes=10)
"""What begins so long after it was due is on time: timers call every few minutes only."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What is done about everything that is due.

    Attributes:
        late: Due too long ago, oldest first; left out.
        instead: Due, and left out in favour of what is chosen.
        chosen: What is to be done, None if nothing is.
        again: Whether that was begun before.
    """

    late: tuple[Occasion, ...] = ()
    instead: tuple[Occasion, ...] = ()
    chosen: Occasion | None = None
    again: bool = False


def choose(
    spec: ScheduleSpec, standing: Standing, now: datetime, due_by: datetime | None = None
) -> Choice:
    """What is done at a moment.

    Args:
        spec: The schedule.
        standing: Of its ledger, which has been started.
        now: The moment.
        due_by: What is due later waits; by default that moment.
    """
    latest = now - lateness(spec)
    if standing.begun and standing.open is not None:
        touched = standing.touched or standing.open.due
        if touched < now - spec.missed_within:
            return Choice(late=(standing.open,))
        return Choice(chosen=standing.open, again=True)
    due = (*((standing.open,) if standing.open else ()), *due_until(spec, standing, due_by or now))
    late = tuple(each for each in due if each.due < latest)
    timely = [each for each in due if each.due >= latest]
    if not timely:
        return Choice(late)
    chosen = max(timely, key=lambda each: (each.job == "campaign", each.due))
    return Choice(late, tuple(each for each in timely if each != chosen), chosen)


def due_until(spec: ScheduleSpec, standing: Standing, now: datetime) -> Sequence[Occasion]:
    """What is due up to `now` and not settled, oldest first, without what is open."""
    assert standing.anchor is not None
    assert standing.until is not None
    coming = occasions(spec, standing.anchor, standing.until)
    return list(takewhile(lambda each: each.due <= now, coming))


def lateness(spec: ScheduleSpec) -> timedelta:
    """How long after it was due something may begin."""
    return spec.missed_within if spec.missed == "run" else PUNCTUAL


def late_words(spec: ScheduleSpec, standing: Standing, late: Sequence[Occasion]) -> str:
    """Why those are left out."""
    limit = duration_text(spec.missed_within)
    if standing.begun and list(late) == [standing.open]:
        return f"begun, and not gone on with within {limit}"
    because = f", {standing.why}" if standing.open in late and standing.why else ""
    if spec.missed == "skip":
        return f"it could not be done on time{because}"
    return f"it could not be done within {limit}{because}"
