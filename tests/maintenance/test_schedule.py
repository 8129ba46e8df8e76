"""Schedules: when something is due, what is refused at once, and the ledger of what was done."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from itertools import islice, takewhile
from pathlib import Path
from time import process_time
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import plugins
from hil.core.errors import (
    DataError,
    RecordingError,
    RobotConnectionError,
    RobotFault,
    SpecError,
    Stopped,
)
from hil.estimators.base import estimator
from hil.maintenance import due_times
from hil.maintenance.binding import Bound, bind
from hil.maintenance.dry_run import Expected, Motions, forecast
from hil.maintenance.due_times import moment_of, next_free, occasions, window_in
from hil.maintenance.ledger import LEDGER_FILE, Ledger, Occasion, occasion_of, open_ledger
from hil.maintenance.scheduler import Command, Interruption, RobotReady, interrupt_at
from hil.maintenance.simulation import with_options
from hil.maintenance.systemd import next_words, units_of, write_units
from hil.planning import robots
from hil.planning.experiment import load as load_experiment
from hil.robot import Finding, Status, state_dtype
from hil.robot.lease import leased
from hil.spec.load import load_station
from hil.spec.schedule import load_schedule_spec
from hil.workflow import checks
from tests.support.paths import EXPERIMENTS
from tests.support.pipeline_parts import CAMPAIGN, FOURIER, PROBE, SCHEDULE, write_schedule
from tests.support.schedule_parts import HOUR, MINUTE, MONDAY, at, never_due, schedule

# When something is due, and when it may begin


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


# Units for systemd, and the command that is told what came of an occasion


ANALYZE = shutil.which("systemd-analyze")
ODD = 'a b/100 % of "$HOME"\\x/nightly.yaml'


@pytest.mark.thorough
@pytest.mark.skipif(ANALYZE is None, reason="no systemd here")
@pytest.mark.parametrize("timer", [False, True], ids=["service", "timer"])
@pytest.mark.parametrize("user", [False, True], ids=["system", "user"])
def test_systemd_finds_nothing_wrong(tmp_path: Path, timer: bool, user: bool) -> None:
    assert ANALYZE
    units = units_of("nightly", (f"/{ODD}",), tmp_path, timer=timer, user=user)
    files = write_units(units, tmp_path)
    command = [ANALYZE, *(["--user"] if user else []), "verify", *map(str, files)]
    surroundings = {"XDG_RUNTIME_DIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, capture_output=True, text=True, env=surroundings, check=False)
    told = [line for line in done.stderr.splitlines() if "hil-nightly" in line]
    assert told == []


def test_a_service_stays_and_a_timer_calls_once(tmp_path: Path) -> None:
    (service,) = units_of("nightly", ("/n.yaml",), tmp_path, timer=False, user=False)
    assert service.name == "hil-nightly.service"
    assert f"ExecStart={sys.executable} -P -m hil schedule run /n.yaml\n" in service.text
    for wanted in ("Type=exec", "Restart=on-failure", "KillSignal=SIGTERM", "User=",
                   "SuccessExitStatus=130", f"WorkingDirectory={tmp_path}"):  # fmt: skip
        assert f"\n{wanted}" in service.text
    called, timer = units_of("nightly", ("/n.yaml",), tmp_path, timer=True, user=True)
    assert "/n.yaml --once\n" in called.text
    assert "Type=oneshot" in called.text
    assert "Restart=" not in called.text
    assert "User=" not in called.text
    assert "Persistent=true" in timer.text
    assert next_words([called, timer], tmp_path, user=True)[-2].endswith("hil-nightly.timer")


def test_paths_are_themselves_whatever_is_in_them(tmp_path: Path) -> None:
    (unit,) = units_of("nightly", (f"/{ODD}",), Path("/100%"), timer=False, user=True)
    assert '"/a b/100 %% of \\"$$HOME\\"\\\\x/nightly.yaml"' in unit.text
    assert "WorkingDirectory=/100%%\n" in unit.text
    with pytest.raises(SpecError, match="not allowed in a systemd unit"):
        units_of("nightly", ("/a\nb",), tmp_path, timer=False, user=True)


def test_the_folder_of_units_is_made(tmp_path: Path) -> None:
    units = units_of("nightly", ("/n.yaml",), tmp_path, timer=True, user=True)
    for path in write_units(units, tmp_path / "new" / "units"):
        assert path.read_text()
    (tmp_path / "file").write_text("")

    with pytest.raises(RecordingError, match="cannot create"):
        write_units(units, tmp_path / "file")


def test_leases_are_looked_for_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_LEASES", "/srv/hil leases")
    monkeypatch.delenv("HIL_STATION", raising=False)
    (unit,) = units_of("nightly", (), tmp_path, timer=False, user=True)
    assert '\nEnvironment="HIL_LEASES=/srv/hil leases"\n' in unit.text
    assert "HIL_STATION" not in unit.text


def test_a_command_is_told_in_json_without_a_shell(tmp_path: Path) -> None:
    out = tmp_path / "told"
    code = "import sys; open(sys.argv[1], 'w').write(sys.argv[2] + '\\n' + sys.stdin.read())"
    command = Command((sys.executable, "-c", code, str(out), "$HOME; ls"), "nightly")
    assert (
        command({"event": "done", "occasion": "x", "result": {"text": "größer"}, "before": "ab"})
        == ""
    )
    argument, told = out.read_text().splitlines()
    assert argument == "$HOME; ls"
    wanted = {"schedule": "nightly", "event": "done", "occasion": "x", "result": {"text": "größer"}}
    assert json.loads(told) == wanted


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("/no/such/command",), "/no/such/command cannot be run: [Errno 2]"),
        (
            ("sh", "-c", "echo first >&2; echo no mail >&2; exit 3"),
            "sh ended with exit code 3: no mail",
        ),
        (("sh", "-c", "kill -9 $$"), "sh ended with exit code -9"),
        (("nul\0",), "nul\0 cannot be run: embedded null"),
    ],
)
def test_a_command_that_fails_is_told(words: tuple[str, ...], told: str) -> None:
    assert Command(words, "nightly")({"event": "done"}).startswith(told)


def test_a_command_that_hangs_is_killed_with_its_children() -> None:
    begin = time.monotonic()
    hangs = Command(("sh", "-c", "sleep 400 & wait"), "nightly", within_s=0.2)
    assert hangs({"event": "done"}) == "sh did not end within 0.2 s"
    assert time.monotonic() - begin < 200


def test_no_command_is_no_problem() -> None:
    assert Command((), "nightly")({"event": "done"}) == ""


# What a schedule would do: told one by one, or regular probes together, it is the same


NOW = at("23 03:00") + timedelta(seconds=20)
MOTIONS = Motions(probe=timedelta(seconds=50), campaign=timedelta(seconds=200))


def dense(every: str = "1min", **keys: Any) -> Any:
    return schedule(probe={"spec": "probe.yaml", "every": every}, **keys)


def expected(spec: Any, hours: float, alike: int | None) -> list[Expected]:
    end = NOW + timedelta(hours=hours)
    return forecast(spec, Ledger(None), MOTIONS, NOW, end, alike=alike)


def counted(found: list[Expected]) -> Counter[tuple[str, str]]:
    counts: Counter[tuple[str, str]] = Counter()
    for one in found:
        counts[one.job, one.what] += one.count
    return counts


@pytest.mark.thorough
@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"every": "7min"},
        {"campaign": {"spec": "campaign.yaml", "cron": "0 */5 * * *"}},
        {"campaign": {"spec": "campaign.yaml", "every": "4h30min"}},
        {"blackout": [{"begin": "07:00", "end": "08:00"}]},
        {"missed": "skip", "start": "2026-11-23T03:05:30"},
    ],
    ids=lambda keys: " ".join(keys) or "plain",
)
@pytest.mark.parametrize("hours", [0.3, 9.99, 26])
def test_regular_probes_are_counted_and_not_lost(keys: dict[str, Any], hours: float) -> None:
    spec = dense(**keys)
    all_of_them, together = (expected(spec, hours, alike) for alike in (None, 10))
    assert counted(together) == counted(all_of_them)
    assert together[-1].due == all_of_them[-1].due
    assert [one for one in together if one.job == "campaign"] == [
        one for one in all_of_them if one.job == "campaign"
    ]


def test_a_year_of_minutes_costs_as_much_as_an_hour() -> None:
    began = process_time()
    (*_, last) = found = expected(dense(), 365 * 24, 40)
    assert process_time() - began < 2
    assert sum(one.count for one in found) == 365 * 24 * 60 + 1
    assert len(found) < 100
    assert last.due == NOW + timedelta(days=365) - timedelta(seconds=20)


# Whether a robot may be used now: asked before anything moves


SPEC = EXPERIMENTS / "ci_fourier_2.yaml"


class Arm:
    """A robot in wall time that can be asked and does not move."""

    resource = "arm@bench"
    connects: Exception | None = None
    findings: Sequence[Finding] = ()

    def __init__(self) -> None:
        self.state = np.zeros(1, state_dtype(6))
        self.closed = 0

    @property
    def capabilities(self) -> Any:
        """In wall time."""
        return checks.Capabilities(  # the rest does not matter here
            joint_names=tuple("abcdef"),
            rate_hz=125.0,
            effort_kind="current",
            drive_gains=(10.0,) * 6,
            clock="wall",
        )

    def connect(self) -> None:
        """Or not."""
        if self.connects:
            raise self.connects

    def read(self) -> Any:
        """One row."""
        return self.state

    def checks(self) -> Sequence[Finding]:
        """What it has found."""
        return self.findings

    def close(self) -> None:
        """Count."""
        self.closed += 1


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Arm:
    made = Arm()
    monkeypatch.setenv("HIL_LEASES", str(tmp_path))
    monkeypatch.setattr(robots, "open_robot", lambda name, described: made)
    return made


def ready(wait_s: float = 0.0) -> str:
    return RobotReady(load_experiment(SPEC), wait_s)()


def test_a_robot_at_rest_without_a_fault_is_ready(arm: Arm) -> None:
    assert ready() == ""
    assert arm.closed


def test_what_keeps_it_from_being_used_is_told(arm: Arm) -> None:
    arm.state["status"], arm.state["fault_code"] = int(Status.FAULT), 7
    arm.state["qd"][0, 2] = 0.5
    arm.findings = [Finding("remote", False, "it is in local control"), Finding("load", True, "")]
    assert ready() == (
        "the controller reports fault code 7; its fastest joint moves at 0.5000 rad/s; "
        "it is in local control"
    )


@pytest.mark.parametrize("error", [RobotFault("protective stop"), RobotConnectionError("no route"),
                                   RuntimeError("a bug")])  # fmt: skip
def test_a_robot_that_does_not_connect_is_not_ready(arm: Arm, error: Exception) -> None:
    arm.connects = error
    assert str(error) in ready()


def test_a_robot_that_somebody_holds_is_waited_for(arm: Arm) -> None:
    experiment = load_experiment(SPEC)
    station = experiment.station_source
    held = leased(arm, name="x", driver="d", station=station)  # type: ignore[arg-type]
    with held:
        assert "is held by pid" in ready()
        threading.Timer(0.4, held.release).start()
        assert ready(wait_s=20) == ""


def test_an_embedded_mock_is_always_ready() -> None:
    assert ready() == ""


def test_a_driver_that_is_not_there_is_told() -> None:
    experiment = load_experiment(SPEC)
    broken = replace(experiment, robot=experiment.robot.model_copy(update={"driver": "none"}))
    assert "none" in RobotReady(broken)()


def soon(seconds: float) -> datetime:
    return datetime.now(UTC) + timedelta(seconds=seconds)


def test_a_blackout_interrupts_what_is_done() -> None:
    begin = time.monotonic()
    with pytest.raises(Interruption), interrupt_at(soon(0.2)):
        time.sleep(400)
    assert time.monotonic() - begin < 200


def test_a_run_that_was_stopped_for_it_is_interrupted() -> None:
    heard: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))

    def run() -> None:
        while not heard:
            time.sleep(0.01)
        raise Stopped("stopped by SIGTERM", by_signal=True)

    with pytest.raises(Interruption), interrupt_at(soon(0.1)):
        run()


def test_what_ends_before_it_ends_as_it_does() -> None:
    with interrupt_at(soon(60)):
        pass
    with interrupt_at(None):
        pass
    with pytest.raises(Stopped), interrupt_at(soon(60)):
        raise Stopped("by hand", by_signal=True)


def test_sigterm_means_again_what_it_meant() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with interrupt_at(soon(60)):
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


# The ledger: what is written is there for good, and one process keeps it


def three_lines(folder: Path) -> Path:
    with open_ledger(folder, "nightly") as ledger:
        ledger.start("nightly", MONDAY)
        ledger.add("begun", MONDAY, occasion="20261123T000000Z-probe", until=MONDAY.isoformat())
        ledger.add("done", MONDAY, occasion="20261123T000000Z-probe", result={"text": "well"})
    return folder / LEDGER_FILE


def test_it_is_read_as_it_was_written(tmp_path: Path) -> None:
    three_lines(tmp_path)
    read = Ledger.read(tmp_path)
    assert [line["event"] for line in read.lines] == ["started", "begun", "done"]
    assert (read.standing.anchor, read.standing.until) == (MONDAY, MONDAY)
    assert read.standing.open is None


def test_what_work_says_may_be_anything_that_json_has_a_word_for(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly") as ledger:
        ledger.start("nightly", MONDAY)
        odd = {"rmse": float("nan"), "text": "\udc80 Größe", "run": tmp_path, "of": (1, 2)}
        line = ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe", result=odd)
        ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe")
    assert Ledger.read(tmp_path).lines[1] == line
    assert line["result"]["rmse"] is None


def test_a_torn_line_is_none_and_is_written_over(tmp_path: Path) -> None:
    path = three_lines(tmp_path)
    path.write_bytes(path.read_bytes()[:-7])
    with open_ledger(tmp_path, "nightly") as ledger:
        assert ledger.standing.begun
        ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe", why="", kind="", hint="")
    assert [line["event"] for line in Ledger.read(tmp_path).lines] == ["started", "begun", "failed"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda raw: raw.replace(b'"until"', b'"untie"'), "does not follow the line before"),
        (lambda raw: raw.replace(b"-probe", b"-prude"), "damaged"),
        (lambda raw: raw.replace(b"{", b"[", 1), "damaged"),
        (lambda raw: b"\n".join([*raw.split(b"\n")[:1], *raw.split(b"\n")[2:]]), "does not follow"),
    ],
)
def test_what_was_changed_is_found(tmp_path: Path, change: object, told: str) -> None:
    path = three_lines(tmp_path)
    path.write_bytes(change(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(DataError, match=told) as error:
        Ledger.read(tmp_path)
    assert str(path) in error.value.message


def test_one_process_keeps_it(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly"):
        with (
            pytest.raises(DataError, match="is run by pid") as error,
            open_ledger(tmp_path, "nightly"),
        ):
            pass
        assert "hil schedule show" in error.value.hint
    with open_ledger(tmp_path, "nightly"):
        pass


def test_it_is_of_one_schedule(tmp_path: Path) -> None:
    three_lines(tmp_path)
    with (
        open_ledger(tmp_path, "weekly") as ledger,
        pytest.raises(DataError, match="'nightly', not of"),
    ):
        ledger.start("weekly", MONDAY)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(RecordingError, match="cannot create"),
        open_ledger(tmp_path / "file" / "a", "n"),
    ):
        pass


def test_in_memory_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ledger = Ledger()
    ledger.start("nightly", MONDAY)
    ledger.folder_of(Occasion(MONDAY, "probe"))
    assert list(tmp_path.iterdir()) == []


def test_an_occasion_is_told_by_its_id() -> None:
    occasion = Occasion(at("23 03:00"), "campaign")
    assert occasion_of(occasion.id) == occasion
    for wrong in ("", "20261123T030000Z", "20261123T030000Z-fit", "today-probe"):
        with pytest.raises(ValueError, match=r".+"):
            occasion_of(wrong)


def test_lines_are_strict_json_with_utc_times(tmp_path: Path) -> None:
    for line in three_lines(tmp_path).read_text().splitlines():
        told = json.loads(line)
        assert datetime.fromisoformat(told["at"]).tzinfo == UTC


# What could only fail at night is refused when a schedule is read: all of it at once


def bound(folder: Path, **changed: Any) -> Bound:
    return bind(load_schedule_spec(write_schedule(folder, **changed)))


def problems(folder: Path, **changed: Any) -> list[str]:
    with pytest.raises(SpecError) as told:
        bound(folder, **changed)
    return told.value.message.splitlines()


def test_a_schedule_is_bound_to_its_experiments(tmp_path: Path) -> None:
    found = bound(tmp_path)
    assert (found.name, found.fit.estimator) == ("ur5", "rigid-wls")
    assert [one.spec.name for one in found.experiments] == ["probe", "campaign"]


def test_the_estimator_is_the_one_that_is_named(tmp_path: Path) -> None:
    both = CAMPAIGN | {"fit": [{"estimator": "rigid-hysteresis"}, {"estimator": "rigid-wls"}]}
    assert bound(tmp_path, campaign=both).fit.estimator == "rigid-hysteresis"
    named = SCHEDULE | {"campaign": {"spec": "campaign.yaml", "estimator": "rigid-wls"}}
    assert bound(tmp_path, campaign=both, schedule=named).fit.estimator == "rigid-wls"
    named = SCHEDULE | {"campaign": {"spec": "campaign.yaml", "estimator": "static-wls"}}
    (told,) = problems(tmp_path, campaign=both, schedule=named)
    assert told == "campaign.estimator: campaign fits rigid-hysteresis, rigid-wls, not 'static-wls'"


def test_a_campaign_needs_one_model(tmp_path: Path) -> None:
    none = {key: value for key, value in CAMPAIGN.items() if key not in ("fit", "validate")}
    assert problems(tmp_path, campaign=none) == [
        "campaign.spec: campaign has no `fit`, so that it yields no model"
    ]
    twice = CAMPAIGN | {"fit": [{"estimator": "rigid-wls"}, {"estimator": "rigid-wls"}]}
    assert "fits rigid-wls 2 times" in "".join(problems(tmp_path, campaign=twice))


def test_a_model_of_a_papers_protocol_is_never_champion(tmp_path: Path) -> None:
    leaky = {"estimator": "static-wls", "form": "paper", "current_term": True}
    dwell = {"kind": "dwell", "waypoints": 40}
    parts = {"validate": {"hold_out": {"poses_percent": 20}}, "fit": [leaky]}
    paper = CAMPAIGN | parts | {"excitation": dwell | {"seed": 7}}
    probe = PROBE | {"excitation": dwell | {"seed": 21}}
    (told,) = problems(tmp_path, campaign=paper, probe=probe)
    words = "the model of static-wls is not fitted under the honest protocol"
    assert told.startswith(f"campaign.estimator: {words}")


def test_a_probe_is_of_the_same_robot_and_of_another_motion(tmp_path: Path) -> None:
    other = PROBE | {"robot": "ur3"}
    (told,) = problems(tmp_path, probe=other)
    assert "probe.spec: drives ur3" in told
    assert "both must use the same robot" in told
    same = PROBE | {"excitation": FOURIER | {"seed": 7, "trajectories": 4}}
    (told,) = problems(tmp_path, probe=same)
    assert "it has the same motion as the campaign" in told


def test_a_probe_that_says_too_little_is_refused(tmp_path: Path) -> None:
    short = PROBE | {"excitation": FOURIER | {"seed": 21, "trajectories": 3}}
    (told,) = problems(tmp_path, probe=short)
    assert "3 trajectories of 5 s are too short to detect a change: at least 20 s" in told
    # Blocks are of whole trajectories: 21 s in three of 7 s are three blocks.
    odd = FOURIER | {"seed": 21, "trajectories": 3, "fundamental_hz": 1 / 7}
    assert len(problems(tmp_path, probe=PROBE | {"excitation": odd})) == 1
    twice = FOURIER | {"seed": 21, "trajectories": 2, "periods": 2}
    more = CAMPAIGN | {"validate": {"hold_out": {"trajectories": 2}}}
    assert bound(tmp_path, probe=PROBE | {"excitation": twice}, campaign=more)


def test_a_schedule_that_could_never_compare_two_models_is_refused(tmp_path: Path) -> None:
    alone = SCHEDULE | {"probe": None, "campaign": {"spec": "campaign.yaml", "every": "7d"}}
    (told,) = problems(tmp_path, schedule=alone)
    assert told.startswith(
        "campaign.spec: the hold-out set of campaign contains 1 distinct blocks of 5 s, but 4 "
        "are required to compare two models"
    )
    more = CAMPAIGN | {"validate": {"hold_out": {"trajectories": 4}}}
    assert bound(tmp_path, schedule=alone, campaign=more)
    # The second period comes by the same places.
    longer = FOURIER | {"seed": 7, "trajectories": 5, "periods": 2}
    two = {"excitation": longer, "validate": {"hold_out": {"trajectories": 2}}}
    (told,) = problems(tmp_path, schedule=alone, campaign=CAMPAIGN | two)
    assert "contains 2 distinct blocks" in told
    # Of loads alone every trajectory is held out.
    loads = {"loads": [{"mass_kg": 0}, {"mass_kg": 2}], "validate": {"hold_out": {"loads": [1]}}}
    assert bound(tmp_path, schedule=alone, campaign=CAMPAIGN | loads)


def test_a_model_that_does_not_tell_friction_apart_is_no_champion_of_probes(tmp_path: Path) -> None:
    dwell = {"kind": "dwell", "waypoints": 40}
    parts = {"fit": [{"estimator": "static-wls"}], "validate": {"hold_out": {"poses_percent": 20}}}
    still = CAMPAIGN | parts | {"excitation": dwell | {"seed": 7}}
    probe = PROBE | {"excitation": dwell | {"seed": 21}}
    (told,) = problems(tmp_path, campaign=still, probe=probe)
    assert told.startswith("campaign.estimator: static-wls does not predict friction separately")
    alone = {"probe": None, "campaign": {"spec": "campaign.yaml", "every": "7d"}}
    assert bound(tmp_path, schedule=SCHEDULE | alone, campaign=still)


@pytest.mark.parametrize(
    "name", [name for name in plugins.names("hil.estimators") if not name.startswith("test")]
)
def test_estimators_say_whether_they_tell_friction_apart(name: str) -> None:
    silent = {"static-wls", "static-linear", "static-inverse"}
    assert estimator(name).tells_friction is (name not in silent)


def test_nobody_answers_at_night(tmp_path: Path) -> None:
    asks = CAMPAIGN | {"loads": [{"mass_kg": 0}, {"mass_kg": 2, "prompt": "Mount 2 kg"}]}
    assert bound(tmp_path, campaign=asks)  # a mock on a virtual clock mounts by itself
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": {"clock": "wall"}}}
    station = {"hil_station": 1, "robots": robots}
    (tmp_path / "station.yaml").write_text(json.dumps(station), "utf-8")
    (told,) = problems(tmp_path, campaign=asks)
    assert told.startswith("campaign.spec: campaign has a prompt ('Mount 2 kg')")


def test_hil_validate_says_all_at_once_with_their_places(tmp_path: Path) -> None:
    broken = PROBE | {"robot": "ur3", "excitation": FOURIER | {"seed": 7, "trajectories": 1}}
    none = {key: value for key, value in CAMPAIGN.items() if key not in ("fit", "validate")}
    file = write_schedule(tmp_path, probe=broken, campaign=none)
    told = CliRunner().invoke(app, ["validate", str(file)])
    lines = str(told.exception).splitlines()
    assert told.exit_code
    assert len([line for line in lines if line.startswith(str(file))]) == 4
    assert f"{file}:9:11: campaign.spec: " in str(told.exception)


def test_hil_validate_of_a_file_that_cannot_be_read_says_what_is_wrong_there(tmp_path) -> None:
    file = write_schedule(tmp_path, campaign=CAMPAIGN | {"warmup": 3}, probe=PROBE | {"hil": 9})
    told = str(CliRunner().invoke(app, ["validate", str(file)]).exception)
    assert "campaign.yaml" in told
    assert "did you mean 'warm_up'" in told
    assert "probe.yaml" in told


def test_hil_validate_tells_what_a_schedule_would_do(tmp_path: Path) -> None:
    file = write_schedule(tmp_path)
    told = json.loads(CliRunner().invoke(app, ["validate", str(file), "--json"]).stdout)
    assert told["valid"] is True
    assert (told["model"], told["estimator"]) == ("ur5", "rigid-wls")
    assert [run["name"] for run in told["runs"]] == ["probe", "campaign"]
    text = CliRunner().invoke(app, ["validate", str(file)]).stdout
    assert f"{file}: valid (models of ur5, rigid-wls)" in text


def test_other_options_are_also_in_the_copy_of_the_station(tmp_path: Path) -> None:
    experiment = bound(tmp_path).campaign
    other = with_options(experiment, {"day": 3, "seed": 4})
    assert other.robot.options == {"day": 3, "seed": 4}
    copy = tmp_path / "copy.yaml"
    copy.write_text(other.station_text, "utf-8")
    assert load_station(copy).robots["ur5"] == other.robot
    assert (other.spec, other.station_source) == (experiment.spec, experiment.station_source)
    assert not experiment.robot.options
