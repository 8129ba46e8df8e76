"""Due times and blackouts, and the choice of what is done; pure functions of schedule and ledger.

Times of day are those of the schedule's time zone. A time that the clock skips (when summer time
begins) is due at the moment of the skip; one that it shows twice is due the first time. Intervals
are of true time. All results are in UTC.

An occasion that was begun is continued first (`choose`). Of the others that are due, one is done:
the latest campaign, or if none is due the latest probe; the rest is left out in its favour, since
one look at the robot is as good as two. What was due too long ago is left out, too.
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
    """Yield the occasions in order; of a probe and a campaign due together, the campaign alone.

    Args:
        spec: The schedule.
        anchor: The minute of its first start: nothing before that is due, and intervals count from
            it unless the schedule has a `start`.
        after: Only those due later than this.
    """
    after = max(after, anchor - timedelta(seconds=1))
    start = begin_of(spec, anchor)

    def stream(job: Job, trigger: Trigger) -> Iterator[Occasion]:
        return (Occasion(due, job) for due in dues(trigger, spec.timezone, start, after))

    streams = [stream("campaign", spec.campaign)]
    if spec.probe is not None:
        streams.append(stream("probe", spec.probe))
    # Of occasions that are due at the same time, the campaign sorts first.
    for _, together in groupby(heapq.merge(*streams), key=lambda each: each.due):
        yield next(together)


def begin_of(spec: ScheduleSpec, anchor: datetime) -> datetime:
    """Return from when intervals count, UTC: the schedule's `start`, else its first start."""
    if spec.start is None:
        return anchor.astimezone(UTC)
    if spec.start.tzinfo is None:
        return moment_of(spec.start, ZoneInfo(spec.timezone))
    return spec.start.astimezone(UTC)


def dues(trigger: Trigger, timezone: str, start: datetime, after: datetime) -> Iterator[datetime]:
    """Yield the due times of a trigger, UTC; endless, unless the calendar has an end.

    Args:
        trigger: An interval, a calendar rule, or neither.
        timezone: Of the calendar.
        start: From when intervals count; it is a due time itself.
        after: Only times later than this.
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
    # Of a time that the clock shows twice the first counts, which may be before `after`: the
    # comparison leaves it out.
    shown = after.astimezone(zone).replace(tzinfo=None)
    wall, before = shown.replace(second=0, microsecond=0), after
    while (following := _next_shown(cron, zone, wall)) is not None:
        wall, due = following[0] + _MINUTE, following[1]
        if due > before:
            yield due
            before = due


@lru_cache(maxsize=1024)  # the loop asks for the same minutes again and again
def _next_shown(cron: str, zone: ZoneInfo, wall: datetime) -> tuple[datetime, datetime] | None:
    """Return the first due time from a local time on: as the local clock shows it, and UTC."""
    fires = _calendar(cron).get_next_fire_time(None, wall.replace(tzinfo=UTC))
    if fires is None:
        return None
    shown = fires.replace(tzinfo=None)
    return shown, moment_of(shown, zone)


@cache
def _calendar(cron: str) -> Any:
    """Return the calendar in UTC, where clocks are never put forward or back."""
    from apscheduler.triggers.cron import CronTrigger

    return CronTrigger.from_crontab(cron, timezone=UTC)


def moment_of(wall: datetime, zone: ZoneInfo, *, last: bool = False) -> datetime:
    """Return when a local clock shows a time, UTC.

    Args:
        wall: Local time, without a time zone.
        zone: Of the clock.
        last: Return the second moment of a time that the clock shows twice.
    """
    shown = wall.replace(tzinfo=zone, fold=int(last))
    moment = shown.astimezone(UTC)
    if moment.astimezone(zone).replace(tzinfo=None, fold=0) == wall:
        return moment
    # A skipped time: by the offset before the skip it is after it, by the offset after it before.
    # The skip is between the two.
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
        begin, end: UTC; the end does not belong to it.
        why: Its time of day and its reason by the schedule.
    """

    begin: datetime
    end: datetime
    why: str


def next_free(
    spec: ScheduleSpec, moment: datetime, lasting: timedelta
) -> tuple[datetime | None, Window | None]:
    """Return when work may begin that takes so long, and what keeps it from beginning now.

    Args:
        spec: The schedule.
        moment: The work begins at this moment or later.
        lasting: How long it takes; it must end before the next blackout.

    Returns:
        The first such moment, UTC, or None if it fits nowhere between blackouts; and the first
        blackout in its way, or None if it may begin at once.
    """
    lasting = max(lasting, timedelta(seconds=1))
    free, first = moment.astimezone(UTC), None
    hopeless = _regular_from(spec, free) + lasting
    while (window := window_in(spec, free, free + lasting)) is not None:
        first = first or window
        free = window.end
        if free > hopeless:
            return None, first
    return free, first


def _regular_from(spec: ScheduleSpec, moment: datetime) -> datetime:
    """Return a moment after two whole weeks whose blackouts are those of every later week."""
    days = [day for one in spec.blackout for day in (one.first, one.last) if day]
    latest = max([moment, *(datetime.combine(day, time(), UTC) for day in days)])
    return latest + 16 * _DAY


def window_in(spec: ScheduleSpec, begin: datetime, end: datetime) -> Window | None:
    """Return the blackout that begins first of those that overlap `begin` … `end`; None if none."""
    zone = ZoneInfo(spec.timezone)
    # A blackout may end on the day after it began; one day more for clocks that are put back.
    day, last = begin.astimezone(zone).date() - 2 * _DAY, end.astimezone(zone).date()
    windows: list[Window] = []
    while day <= last and not windows:
        of_day = (_window(one, day, zone) for one in spec.blackout if _begins_on(one, day))
        windows = [each for each in of_day if each.begin < end and begin < each.end]
        day += _DAY
    return min(windows, key=lambda window: window.begin, default=None)


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


def _begins_on(blackout: Blackout, day: date) -> bool:
    """Return whether a blackout begins on a day."""
    in_season = (blackout.first or day) <= day <= (blackout.last or day)
    return in_season and (not blackout.days or _DAYS[day.weekday()] in blackout.days)


@dataclass(frozen=True, slots=True)
class Choice:
    """What is done with everything that is due.

    Attributes:
        late: Due too long ago, oldest first; left out.
        instead: Due, and left out in favour of `occasion`.
        occasion: To be done; None if nothing is.
        again: Whether it was begun before.
    """

    late: tuple[Occasion, ...] = ()
    instead: tuple[Occasion, ...] = ()
    occasion: Occasion | None = None
    again: bool = False


def choose(
    spec: ScheduleSpec, standing: Standing, now: datetime, due_by: datetime | None = None
) -> Choice:
    """Return what is done at a moment.

    Args:
        spec: The schedule.
        standing: State of its ledger, which has been started.
        now: The moment.
        due_by: Occasions that are due later wait; by default `now`.
    """
    latest = now - lateness(spec)
    if standing.begun and standing.open is not None:
        touched = standing.touched or standing.open.due
        if touched < now - spec.missed_within:
            return Choice(late=(standing.open,))
        return Choice(occasion=standing.open, again=True)
    due = (*((standing.open,) if standing.open else ()), *due_until(spec, standing, due_by or now))
    late = tuple(each for each in due if each.due < latest)
    timely = [each for each in due if each.due >= latest]
    if not timely:
        return Choice(late)
    occasion = max(timely, key=lambda each: (each.job == "campaign", each.due))
    return Choice(late, tuple(each for each in timely if each != occasion), occasion)


def due_until(spec: ScheduleSpec, standing: Standing, now: datetime) -> Sequence[Occasion]:
    """Return what is due up to `now` and not settled, oldest first, without the open occasion."""
    assert standing.anchor is not None
    assert standing.until is not None
    coming = occasions(spec, standing.anchor, standing.until)
    return list(takewhile(lambda each: each.due <= now, coming))


PUNCTUAL = timedelta(minutes=10)
"""What begins at most so long after it was due is on time: a timer calls every few minutes only."""


def lateness(spec: ScheduleSpec) -> timedelta:
    """Return how long after it was due an occasion may begin."""
    return spec.missed_within if spec.missed == "run" else PUNCTUAL


def late_words(spec: ScheduleSpec, standing: Standing, late: Sequence[Occasion]) -> str:
    """Return why late occasions are left out."""
    limit = duration_text(spec.missed_within)
    if standing.begun and list(late) == [standing.open]:
        return f"begun, and not gone on with within {limit}"
    because = f", {standing.why}" if standing.open in late and standing.why else ""
    if spec.missed == "skip":
        return f"it could not be done on time{because}"
    return f"it could not be done within {limit}{because}"
