"""Due times, blackouts and choice of the next occasion, as pure functions of schedule and ledger.

Times of day in a schedule are in the time zone of the schedule. If the local clock skips a due time
(at the start of summer time), the due time is the moment of the skip. If the local clock shows a
due time twice, the first of the two moments counts. Intervals between due times are in elapsed
time. All returned times are in UTC.

An occasion that was begun earlier is continued before any other occasion (`choose`). Only one of
the other due occasions is done: the latest campaign or, if no campaign is due, the latest probe.
The remaining due occasions are omitted, because two measurements of the robot at the same time are
no better than one. Occasions that were due too long ago are omitted as well.
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
    """Yield the occasions in order; if probe and campaign are due together, only the campaign.

    Args:
        spec: Schedule.
        anchor: Minute in which the schedule was started for the first time. No occasion is due
            before `anchor`, and intervals count from `anchor` unless the schedule has a `start`.
        after: Time after which occasions are yielded.
    """
    after = max(after, anchor - timedelta(seconds=1))
    start = begin_of(spec, anchor)

    def stream(job: Job, trigger: Trigger) -> Iterator[Occasion]:
        return (Occasion(due, job) for due in dues(trigger, spec.timezone, start, after))

    streams = [stream("campaign", spec.campaign)]
    if spec.probe is not None:
        streams.append(stream("probe", spec.probe))
    # If occasions are due at the same time, the campaign sorts first.
    for _, together in groupby(heapq.merge(*streams), key=lambda each: each.due):
        yield next(together)


def begin_of(spec: ScheduleSpec, anchor: datetime) -> datetime:
    """Return the time from which intervals count, UTC: `start`, or else the first start."""
    if spec.start is None:
        return anchor.astimezone(UTC)
    if spec.start.tzinfo is None:
        return moment_of(spec.start, ZoneInfo(spec.timezone))
    return spec.start.astimezone(UTC)


def dues(trigger: Trigger, timezone: str, start: datetime, after: datetime) -> Iterator[datetime]:
    """Yield the due times of a trigger, UTC; the sequence is endless unless a calendar rule ends.

    Args:
        trigger: Interval, calendar rule, or neither of the two.
        timezone: Time zone of the calendar rule.
        start: Time from which intervals count; this time is itself a due time.
        after: Time after which due times are yielded.
    """
    if trigger.every is not None:
        yield from _intervals(trigger.every, start, after)
    elif trigger.cron is not None:
        yield from _by_calendar(trigger.cron, ZoneInfo(timezone), after)


def _intervals(every: timedelta, start: datetime, after: datetime) -> Iterator[datetime]:
    count = max(0, (after - start) // every)
    while True:
        try:
            # Due times in the ledger are whole seconds.
            due = (start + count * every).replace(microsecond=0)
        except OverflowError:
            return
        if due > after:
            yield due
        count += 1


_MINUTE, _DAY = timedelta(minutes=1), timedelta(days=1)


def _by_calendar(cron: str, zone: ZoneInfo, after: datetime) -> Iterator[datetime]:
    # If the clock shows a time twice, the first one counts. It may be before `after`, so it is
    # compared below.
    shown = after.astimezone(zone).replace(tzinfo=None)
    wall, before = shown.replace(second=0, microsecond=0), after
    while (following := _next_shown(cron, zone, wall)) is not None:
        wall, due = following[0] + _MINUTE, following[1]
        if due > before:
            yield due
            before = due


@lru_cache(maxsize=1024)  # the loop calls this repeatedly with the same minutes
def _next_shown(cron: str, zone: ZoneInfo, wall: datetime) -> tuple[datetime, datetime] | None:
    """Return the first due time at or after a local time, as local time and as UTC."""
    fires = _calendar(cron).get_next_fire_time(None, wall.replace(tzinfo=UTC))
    if fires is None:
        return None
    shown = fires.replace(tzinfo=None)
    return shown, moment_of(shown, zone)


@cache
def _calendar(cron: str) -> Any:
    """Return the calendar rule in UTC, which has no clock changes."""
    from apscheduler.triggers.cron import CronTrigger

    return CronTrigger.from_crontab(cron, timezone=UTC)


def moment_of(wall: datetime, zone: ZoneInfo, *, last: bool = False) -> datetime:
    """Return the moment, UTC, at which a local clock shows a time.

    Args:
        wall: Local time, without a time zone.
        zone: Time zone of the local clock.
        last: Flag; if true, the second moment is returned for a time that the clock shows twice.
    """
    shown = wall.replace(tzinfo=zone, fold=int(last))
    moment = shown.astimezone(UTC)
    if moment.astimezone(zone).replace(tzinfo=None, fold=0) == wall:
        return moment
    # A skipped time. The offset from before the skip gives a moment after it, and the offset from
    # after the skip a moment before it. The skip is between the two.
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
    """Period in which no occasion may be done.

    Attributes:
        begin, end: Bounds of the period, UTC; the end does not belong to the period.
        why: Time of day and reason of the blackout, as stated in the schedule.
    """

    begin: datetime
    end: datetime
    why: str


def next_free(
    spec: ScheduleSpec, moment: datetime, lasting: timedelta
) -> tuple[datetime | None, Window | None]:
    """Return the time at which work may begin, and the first blackout before that time.

    Args:
        spec: Schedule.
        moment: Earliest time at which the work may begin.
        lasting: Duration of the work, which must end before the next blackout.

    Returns:
        First time at which the work may begin, UTC, or None if the work fits nowhere between
        blackouts. Blackout that prevents the work from beginning at `moment`, or None if there is
        no such blackout.
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
    """Return a time by which two regular weeks have passed; later weeks repeat the blackouts."""
    days = [day for one in spec.blackout for day in (one.first, one.last) if day]
    latest = max([moment, *(datetime.combine(day, time(), UTC) for day in days)])
    return latest + 16 * _DAY


def window_in(spec: ScheduleSpec, begin: datetime, end: datetime) -> Window | None:
    """Return the earliest blackout that overlaps `begin` … `end`, or None if there is none."""
    zone = ZoneInfo(spec.timezone)
    # A blackout may end on the day after its beginning; clock changes need one more day.
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
    """Return whether a blackout begins on a given day."""
    in_season = (blackout.first or day) <= day <= (blackout.last or day)
    return in_season and (not blackout.days or _DAYS[day.weekday()] in blackout.days)


@dataclass(frozen=True, slots=True)
class Choice:
    """Choice between all due occasions of a schedule.

    Attributes:
        late: Occasions that are omitted because they were due too long ago, oldest first.
        instead: Due occasions that are omitted in favour of `occasion`.
        occasion: Occasion to do now; None if there is none.
        again: Flag; true if `occasion` was begun earlier.
    """

    late: tuple[Occasion, ...] = ()
    instead: tuple[Occasion, ...] = ()
    occasion: Occasion | None = None
    again: bool = False


def choose(
    spec: ScheduleSpec, standing: Standing, now: datetime, due_by: datetime | None = None
) -> Choice:
    """Return the choice between all occasions that are due at a moment.

    Args:
        spec: Schedule.
        standing: State of the schedule's ledger, which must have a `started` line.
        now: Current time.
        due_by: Time limit of due times; occasions due later wait. None for `now`.
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
    """Return the unsettled occasions due up to `now`, oldest first, without the open occasion."""
    assert standing.anchor is not None
    assert standing.until is not None
    coming = occasions(spec, standing.anchor, standing.until)
    return list(takewhile(lambda each: each.due <= now, coming))


PUNCTUAL = timedelta(minutes=10)
"""Maximum delay of an occasion that counts as on time; a timer checks only every few minutes."""


def lateness(spec: ScheduleSpec) -> timedelta:
    """Return the maximum delay after its due time with which an occasion may begin."""
    return spec.missed_within if spec.missed == "run" else PUNCTUAL


def late_words(spec: ScheduleSpec, standing: Standing, late: Sequence[Occasion]) -> str:
    """Return the reason why late occasions are omitted."""
    limit = duration_text(spec.missed_within)
    if standing.begun and list(late) == [standing.open]:
        return f"begun, but not resumed within {limit}"
    because = f", {standing.why}" if standing.open in late and standing.why else ""
    if spec.missed == "skip":
        return f"it could not be done on time{because}"
    return f"it could not be done within {limit}{because}"
