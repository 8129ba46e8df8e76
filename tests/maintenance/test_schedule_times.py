"""When something is due, and when it may begin."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from itertools import islice, takewhile
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.maintenance import due_times
from hil.maintenance.due_times import moment_of, next_free, occasions, window_in
from tests.support.schedule_parts import HOUR, MINUTE, MONDAY, at, never_due, schedule

BERLIN = ZoneInfo("Europe/Berlin")
ZONES = ("Europe/Berlin", "America/New_York", "Australia/Lord_Howe", "Asia/Kolkata", "UTC")
DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


def due(spec: Any, anchor: datetime, end: datetime, after: datetime | None = None) -> list[Any]:
    return list(takewhile(lambda o: o.due <= end, occasions(spec, anchor, after or anchor - HOUR)))


@settings(max_examples=40, deadline=None)
@given(
    zone=st.sampled_from(ZONES),
    hour=st.integers(0, 23),
    minute=st.integers(0, 59),
    days=st.sets(st.sampled_from(DAYS), min_size=1),
)
def test_a_time_of_day_comes_once_on_each_of_its_days(
    zone: str, hour: int, minute: int, days: set[str]
) -> None:
    cron = f"{minute} {hour} * * {','.join(sorted(days))}"
    spec = schedule(probe={"spec": "p", "cron": cron}, timezone=zone)
    there, begin = ZoneInfo(zone), datetime(2026, 1, 1, 12, tzinfo=UTC)
    found = [o.due.astimezone(there) for o in due(spec, begin, begin + timedelta(days=365))]
    first, last = (moment.astimezone(there).date() for moment in (begin, begin + 365 * 24 * HOUR))
    every_day = (first + timedelta(days=i) for i in range((last - first).days + 1))
    wanted = {day for day in every_day if DAYS[day.weekday()] in days} - {first, last}
    assert sorted(wanted) == [each.date() for each in found if each.date() not in (first, last)]
    for each in found:
        shows = (each.hour, each.minute) == (hour, minute)
        assert shows or each.utcoffset() != (each - HOUR).utcoffset()  # it was skipped


def test_a_time_that_the_clock_skips_comes_when_it_skips() -> None:
    spec = schedule(probe={"spec": "p", "cron": "30 2 * * *"}, timezone="Europe/Berlin")
    found = due(spec, datetime(2026, 3, 28, tzinfo=UTC), datetime(2026, 3, 30, 12, tzinfo=UTC))
    shown = [f"{o.due.astimezone(BERLIN):%d %H:%M}" for o in found]
    assert shown == ["28 02:30", "29 03:00", "30 02:30"]


def test_a_time_that_the_clock_shows_twice_comes_once() -> None:
    spec = schedule(probe={"spec": "p", "cron": "30 2 * * *"}, timezone="Europe/Berlin")
    found = due(spec, datetime(2026, 10, 24, 12, tzinfo=UTC), datetime(2026, 10, 26, tzinfo=UTC))
    assert [o.id for o in found] == ["20261025T003000Z-probe"]


def test_several_skipped_times_are_one() -> None:
    spec = schedule(probe={"spec": "p", "cron": "*/20 * * * *"}, timezone="Europe/Berlin")
    half_past = datetime(2026, 3, 29, 0, 30, tzinfo=UTC)
    found = due(spec, half_past, half_past + HOUR, half_past)
    assert [f"{o.due:%H:%M}" for o in found] == ["00:40", "01:00", "01:20"]


@settings(max_examples=60, deadline=None)
@given(minutes=st.integers(1, 50_000), late=st.integers(0, 500_000))
def test_intervals_count_from_the_start_however_late_one_looks(minutes: int, late: int) -> None:
    spec = schedule(probe={"spec": "p", "every": f"{minutes}min"})
    after = MONDAY + late * MINUTE
    first, second = islice(occasions(spec, MONDAY, after), 2)
    assert (first.due - MONDAY) % (minutes * MINUTE) == timedelta()
    assert timedelta() < first.due - after <= minutes * MINUTE
    assert second.due - first.due == minutes * MINUTE


def test_the_start_is_due_itself_and_nothing_before_the_first_start_is() -> None:
    spec = schedule(probe={"spec": "p", "every": "1d"})
    assert next(occasions(spec, MONDAY, MONDAY - HOUR)).due == MONDAY
    since = schedule(probe={"spec": "p", "every": "1d"}, start="2026-01-01T05:00")
    assert next(occasions(since, MONDAY, MONDAY - 90 * HOUR)).due == at("23 05:00")
    coming = schedule(probe={"spec": "p", "every": "1d"}, start="2026-11-29T05:00")
    assert next(occasions(coming, MONDAY, MONDAY)).due == at("29 05:00")


def test_a_start_without_a_zone_is_of_the_schedules() -> None:
    keys: dict[str, Any] = {"probe": {"spec": "p", "every": "7d"}, "timezone": "Europe/Berlin"}
    naive = schedule(**keys, start="2026-12-01T03:00")
    aware = schedule(**keys, start="2026-12-01T02:00Z")
    assert next(occasions(naive, MONDAY, MONDAY)) == next(occasions(aware, MONDAY, MONDAY))


def test_where_both_are_due_the_campaign_is_done() -> None:
    spec = schedule(campaign={"spec": "c", "cron": "0 3 * * wed"})
    found = due(spec, MONDAY, MONDAY + 96 * HOUR)
    assert [o.id.split("-")[1] for o in found] == ["probe", "probe", "campaign", "probe"]


def test_looking_again_in_between_finds_the_same() -> None:
    for zone, begin in (
        ("Europe/Berlin", datetime(2026, 3, 28, 23, tzinfo=UTC)),
        ("Europe/Berlin", datetime(2026, 10, 24, 23, tzinfo=UTC)),
        ("Pacific/Apia", datetime(2011, 12, 30, 8, tzinfo=UTC)),  # a whole day is skipped
    ):
        spec = schedule(probe={"spec": "p", "cron": "*/20 * * * *"}, timezone=zone)
        whole = due(spec, begin, begin + 5 * HOUR, begin)
        for minutes in range(0, 300, 7):
            after = begin + minutes * MINUTE + timedelta(seconds=13)
            left = [each for each in whole if each.due > after]
            assert due(spec, begin, begin + 5 * HOUR, after) == left


def test_a_dense_calendar_is_walked_no_further_than_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, moment = [], due_times.moment_of
    monkeypatch.setattr(due_times, "moment_of", lambda *a, **k: asked.append(a) or moment(*a, **k))
    spec = schedule(probe={"spec": "p", "cron": "* * * * *"}, timezone="Asia/Tokyo")
    for minutes in range(60):
        now = MONDAY + minutes * MINUTE
        for _ in range(3):
            assert next(occasions(spec, MONDAY, now)).due == now + MINUTE
    assert len(asked) < 70


def test_a_calendar_that_ends_ends() -> None:
    assert list(occasions(never_due(), MONDAY, MONDAY)) == []


CLOCKS = st.integers(0, 95).map(lambda k: f"{k // 4:02d}:{k % 4 * 15:02d}")


@st.composite
def blackouts(draw: st.DrawFn) -> dict[str, Any]:
    begin = draw(CLOCKS)
    end = draw(st.one_of(CLOCKS, st.just("24:00")).filter(lambda end: end != begin))
    days = draw(st.lists(st.sampled_from(DAYS), min_size=1, max_size=3, unique=True))
    first = date(2026, 11, 20) + timedelta(days=draw(st.integers(0, 6)))
    last = first + timedelta(days=draw(st.integers(0, 6)))
    return {"begin": begin, "end": end, "days": days} | draw(
        st.sampled_from([{}, {"first": first}, {"last": last}, {"first": first, "last": last}])
    )


def is_black(told: list[dict[str, Any]], moment: datetime) -> bool:
    """By looking at the clock, at two days: that on which it began may be yesterday."""
    for one in told:
        begin, end = (int(one[k][:2]) * 60 + int(one[k][3:]) for k in ("begin", "end"))
        end += 1440 if end <= begin else 0
        for back in (0, 1):
            day = moment.date() - timedelta(days=back)
            minute = moment.hour * 60 + moment.minute + 1440 * back
            in_season = one.get("first", day) <= day <= one.get("last", day)
            if in_season and DAYS[day.weekday()] in one["days"] and begin <= minute < end:
                return True
    return False


@settings(max_examples=60, deadline=None)
@given(
    told=st.lists(blackouts(), min_size=1, max_size=3),
    wait=st.integers(0, 4 * 96),
    long=st.integers(1, 40),
)
def test_what_may_begin_ends_before_the_next_blackout_and_no_earlier_time_would_do(
    told: list[dict[str, Any]], wait: int, long: int
) -> None:
    step = 15 * MINUTE
    moment = MONDAY + wait * step
    free, _ = next_free(schedule(blackout=told), moment, long * step)
    if free is None:
        free = moment + 16 * 24 * HOUR
    else:
        assert not any(is_black(told, free + k * step) for k in range(long))
    black = [is_black(told, moment + k * step) for k in range((free - moment) // step + long)]
    for k in range((free - moment) // step):
        assert any(black[k : k + long])


def test_what_is_in_the_way_is_told() -> None:
    nights = {"days": ["mon"], "begin": "22:00", "end": "06:00", "why": "night shift"}
    spec = schedule(blackout=[nights])
    free, window = next_free(spec, at("23 21:30"), HOUR)
    assert free == at("24 06:00")
    assert window is not None
    assert window.why == "blackout 22:00 to 06:00 (night shift)"
    assert next_free(spec, at("23 21:00"), HOUR) == (at("23 21:00"), None)
    assert window_in(spec, at("24 06:00"), at("30 22:00")) is None


def test_what_fits_nowhere_is_told() -> None:
    spec = schedule(blackout=[{"begin": "08:00", "end": "06:00"}])
    assert next_free(spec, MONDAY, 2 * HOUR)[0] == at("23 06:00")
    assert next_free(spec, MONDAY, 2 * HOUR + MINUTE)[0] is None


def test_a_long_holiday_ends() -> None:
    spec = schedule(blackout=[{"first": "2026-12-01", "last": "2028-01-31"}])
    free, window = next_free(spec, datetime(2026, 12, 1, tzinfo=UTC), HOUR)
    assert window is not None
    assert window.why == "blackout 2026-12-01 to 2028-01-31"
    assert free == datetime(2028, 2, 1, tzinfo=UTC)


def test_blackouts_keep_the_schedules_time_and_last_through_the_hour_that_comes_twice() -> None:
    night = [{"begin": "01:00", "end": "02:30"}]
    spec = schedule(timezone="Europe/Berlin", blackout=night)
    late = datetime(2026, 10, 24, 23, tzinfo=UTC)
    window = window_in(spec, late, late + 5 * HOUR)
    assert window is not None
    assert window.end - window.begin == 2.5 * HOUR
    summer = next_free(spec, datetime(2026, 7, 1, 23, 30, tzinfo=UTC), MINUTE)[0]
    winter = next_free(spec, datetime(2026, 12, 1, 0, 30, tzinfo=UTC), MINUTE)[0]
    assert summer == datetime(2026, 7, 2, 0, 30, tzinfo=UTC)
    assert winter == datetime(2026, 12, 1, 1, 30, tzinfo=UTC)


@pytest.mark.parametrize("zone", ZONES)
def test_a_clock_on_the_wall_is_read_as_it_is_shown(zone: str) -> None:
    there = ZoneInfo(zone)
    for hours in range(0, 8760, 7):
        moment = datetime(2026, 1, 1, tzinfo=UTC) + hours * HOUR
        shown = moment.astimezone(there)
        assert moment_of(shown.replace(tzinfo=None, fold=0), there, last=bool(shown.fold)) == moment
