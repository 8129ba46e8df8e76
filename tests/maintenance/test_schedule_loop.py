"""The loop of a schedule: what is due is done once, whatever comes between."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.core.errors import (
    DataError,
    FitError,
    InterlockTripped,
    RobotConnectionError,
    RobotError,
    RobotFault,
    RobotTimeout,
    StaleState,
    Stopped,
)
from hil.maintenance.dry_run import Motions, forecast
from hil.maintenance.ledger import LEDGER_FILE, Ledger, Occasion, hold, open_ledger, release
from hil.maintenance.reidentifying import Measuring
from hil.maintenance.scheduler import Interruption, Scheduler
from hil.planning.experiment import load as load_experiment
from tests.support.pipeline_parts import PROBE, write_schedule
from tests.support.schedule_killing import killed_at_random
from tests.support.schedule_parts import (
    HOUR,
    MINUTE,
    MONDAY,
    anything_may_happen,
    at,
    events,
    never_due,
    raising,
    schedule,
    scheduler,
)

# The loop: what is due is done once, whatever comes between


if TYPE_CHECKING:
    from collections.abc import Iterator
MON, TUE, WED = (f"202611{day}T030000Z-probe" for day in (23, 24, 25))


def test_what_is_due_is_done_when_it_is() -> None:
    loop, worker, clock = scheduler(schedule())
    loop.run(at("25 12:00"))
    assert worker.done == [MON, TUE, WED]
    assert clock.now() == at("25 12:00")
    begun = [line["at"] for line in loop.ledger.lines if line["event"] == "begun"]
    assert begun == [f"2026-11-{day}T03:00:00+00:00" for day in (23, 24, 25)]


def test_work_that_takes_longer_than_its_interval_has_an_end() -> None:
    """Something is always due then; the loop ends all the same when it should."""
    loop, worker, clock = scheduler(schedule(probe={"spec": "probe.yaml", "every": "1min"}))
    worker.lasting = timedelta(seconds=94)
    loop.run(MONDAY + HOUR)
    assert clock.now() < MONDAY + HOUR + 2 * MINUTE
    assert 30 <= len(worker.done) <= 3600 / 94 + 1


def test_once_is_over_when_what_was_due_then_is_done() -> None:
    """Though something came due meanwhile: that is for the next call, which settles all of it."""
    loop, worker, clock = scheduler(schedule(probe={"spec": "probe.yaml", "every": "1min"}))
    worker.lasting = timedelta(seconds=130)
    clock.sleep_until(MONDAY + HOUR)
    loop.run_once()
    first, begun = list(worker.done), clock.now()
    assert len(first) == 1
    assert begun == MONDAY + HOUR + timedelta(seconds=130)
    loop.run_once()
    assert len(worker.done) == 2
    missed = [line for line in loop.ledger.lines if line["event"] == "missed"]
    assert missed[-1]["count"] == 1


def test_what_was_started_within_the_minute_is_due(tmp_path: Path) -> None:
    loop, worker, _ = scheduler(schedule(), at("23 03:00") + timedelta(seconds=2))
    loop.run_due()
    assert worker.done == [MON]


def test_a_restart_repeats_nothing(tmp_path: Path) -> None:
    for hour in range(0, 60, 7):
        with open_ledger(tmp_path, "nightly") as ledger:
            loop, _, _ = scheduler(schedule(), MONDAY + hour * HOUR, ledger)
            loop.run(MONDAY + (hour + 7) * HOUR)
    done = [which for event, which in events(Ledger.read(tmp_path)) if event == "done"]
    assert done == [MON, TUE, WED]


def test_what_was_begun_is_gone_on_with_first_and_in_its_folder(tmp_path: Path) -> None:
    for moment in (at("23 03:00"), at("24 02:00")):
        ledger = Ledger.read(tmp_path)
        loop, worker, _ = scheduler(schedule(), moment, ledger)
        worker.then = [raising(KeyboardInterrupt())] if moment == at("23 03:00") else []
        if worker.then:
            with pytest.raises(Stopped) as stopped:
                loop.run_due()
            assert stopped.value.by_signal
        else:
            loop.run(at("24 04:00"))
            assert worker.done == [MON, TUE]
        assert worker.folders[0] == tmp_path / "occasions" / MON
    ends = [each for each in events(Ledger.read(tmp_path)) if each[0] in ("done", "missed")]
    assert ends == [("done", MON), ("done", TUE)]


@pytest.mark.parametrize("cut", [KeyboardInterrupt(), Stopped("SIGTERM", by_signal=True)])
def test_what_became_due_meanwhile_is_done_after_what_was_cut_off(cut: BaseException) -> None:
    spec = schedule(campaign={"spec": "c", "cron": "30 3 * * *"})
    loop, worker, _ = scheduler(spec, at("23 03:00"))
    worker.then = [raising(cut)]
    with pytest.raises(Stopped):
        loop.run_due()
    assert loop.ledger.standing.begun
    loop, worker, _ = scheduler(spec, at("23 04:00"), loop.ledger)
    loop.run_due()
    assert worker.done == [MON, "20261123T033000Z-campaign"]


def test_what_became_due_beside_what_waits_wakes_nobody() -> None:
    loop, worker, clock = scheduler(schedule(probe={"spec": "p", "every": "1h"}))
    worker.then = [raising(KeyboardInterrupt())]
    with pytest.raises(Stopped):
        loop.run_due()
    loop.ready = lambda: "held"
    clock.sleep_until(at("23 03:30"))
    loop.run_due()
    assert loop.next_moment() == at("23 03:31")


def test_what_was_begun_too_long_ago_is_left_out(tmp_path: Path) -> None:
    loop, worker, _ = scheduler(schedule(), at("23 03:00"), Ledger(tmp_path))
    worker.then = [raising(KeyboardInterrupt())]
    with pytest.raises(Stopped):
        loop.run_due()
    loop, worker, _ = scheduler(schedule(), at("24 10:00"), Ledger.read(tmp_path))
    loop.run_due()
    assert worker.done == [TUE]
    left = next(line for line in loop.ledger.lines if line["event"] == "missed")
    assert (left["occasion"], left["why"]) == (MON, "begun, but not resumed within 1d")


def test_after_days_off_the_latest_is_done_once() -> None:
    spec = schedule(probe={"spec": "p", "every": "6h"})
    loop, worker, clock = scheduler(spec)
    loop.run_due()
    clock.sleep_until(at("26 13:00"))
    loop.run_due()
    assert worker.done[1:] == ["20261126T120000Z-probe"]
    missed = [line for line in loop.ledger.lines if line["event"] == "missed"]
    assert [(line["since"], line["occasion"], line["count"]) for line in missed] == [
        ("20261123T060000Z-probe", "20261125T120000Z-probe", 10),
        ("20261125T180000Z-probe", "20261126T060000Z-probe", 3),
    ]
    assert missed[0]["why"] == "it could not be done within 1d"
    assert missed[1]["why"] == "20261126T120000Z-probe replaces it"


def test_skipping_leaves_out_what_is_not_on_time() -> None:
    loop, worker, clock = scheduler(schedule(missed="skip"))
    clock.sleep_until(at("23 03:11"))
    loop.run_due()
    assert worker.done == []
    assert events(loop.ledger)[1:] == [("missed", MON)]
    clock.sleep_until(at("24 03:09"))
    loop.run_due()
    assert worker.done == [TUE]


def test_of_what_has_waited_the_campaign_is_done() -> None:
    spec = schedule(campaign={"spec": "c", "cron": "0 12 * * mon"}, missed_within="2d")
    loop, worker, clock = scheduler(spec)
    clock.sleep_until(at("24 04:00"))
    loop.run_due()
    assert worker.done == ["20261123T120000Z-campaign"]
    missed = next(line for line in loop.ledger.lines if line["event"] == "missed")
    assert (missed["since"], missed["occasion"], missed["count"]) == (MON, TUE, 2)


def test_a_robot_that_is_not_free_is_asked_every_minute_and_noted_once() -> None:
    busy = ["held by pid 7"] * 5
    loop, worker, _ = scheduler(schedule(), ready=lambda: busy.pop() if busy else "")
    loop.run(at("23 04:00"))
    assert events(loop.ledger)[1:] == [("deferred", MON), ("begun", MON), ("done", MON)]
    begun = next(line for line in loop.ledger.lines if line["event"] == "begun")
    assert begun["at"] == "2026-11-23T03:05:00+00:00"
    assert worker.done == [MON]


def test_a_robot_that_is_never_free_is_given_up_and_says_why() -> None:
    spec = schedule(missed_within="2h")
    loop, worker, _ = scheduler(spec, ready=lambda: "the brakes are on")
    loop.run(at("23 12:00"))
    assert worker.done == []
    assert events(loop.ledger)[1:] == [("deferred", MON), ("missed", MON)]
    last = loop.ledger.lines[-1]
    assert last["why"] == "it could not be done within 2h, the brakes are on"
    assert last["at"] == "2026-11-23T05:01:00+00:00"


def test_a_newer_occasion_stands_for_one_that_waits(tmp_path: Path) -> None:
    spec, ledger = schedule(probe={"spec": "p", "every": "6h"}), Ledger(tmp_path)
    loop, worker, _ = scheduler(spec, ledger=ledger, ready=lambda: "held")
    loop.run(at("23 06:02"))
    loop, worker, _ = scheduler(spec, at("23 06:03"), Ledger.read(tmp_path))
    loop.run(at("23 07:00"))
    assert worker.done == ["20261123T060000Z-probe"]
    assert events(loop.ledger).count(("missed", "20261123T000000Z-probe")) == 1


@pytest.mark.parametrize("keys", [{"missed": "skip"}, {"missed_within": "10min"}])
def test_what_is_too_late_when_the_robot_comes_free_is_left_out(keys: dict[str, str]) -> None:
    loop, worker, clock = scheduler(schedule(**keys))

    def ready() -> str:
        clock.advance(11 * MINUTE)
        return ""

    loop.ready = ready
    loop.run(at("23 12:00"))
    assert worker.done == []
    assert events(loop.ledger)[1:] == [("missed", MON)]


def test_what_becomes_due_while_the_robot_is_waited_for_is_done_after_it() -> None:
    spec = schedule(campaign={"spec": "c", "cron": "5 3 * * *"})
    loop, worker, clock = scheduler(spec)

    def ready() -> str:
        clock.advance(6 * MINUTE)
        return ""

    loop.ready = ready
    loop.run(at("23 12:00"))
    assert worker.done == [MON, "20261123T030500Z-campaign"]


def test_what_would_reach_into_a_blackout_waits_for_its_end() -> None:
    spec = schedule(blackout=[{"begin": "03:30", "end": "08:00", "why": "shift"}])
    loop, _, _ = scheduler(spec, lasting=lambda job: HOUR)
    loop.run(at("23 12:00"))
    assert events(loop.ledger)[1:] == [("deferred", MON), ("begun", MON), ("done", MON)]
    begun = next(line for line in loop.ledger.lines if line["event"] == "begun")
    assert begun["at"] == "2026-11-23T08:00:00+00:00"
    assert loop.ledger.lines[1]["why"] == "blackout 03:30 to 08:00 (shift)"


@pytest.mark.parametrize("keys", [{"missed": "skip"}, {"missed_within": "4h"}])
def test_what_a_blackout_keeps_too_long_is_left_out_at_once(keys: dict[str, str]) -> None:
    spec = schedule(blackout=[{"begin": "02:00", "end": "08:00"}], **keys)
    loop, worker, _ = scheduler(spec)
    loop.run(at("23 12:00"))
    assert worker.done == []
    assert events(loop.ledger)[1:] == [("missed", MON)]
    assert loop.ledger.lines[1]["at"] == "2026-11-23T03:00:00+00:00"


def test_a_robot_that_was_waited_for_until_a_blackout_waits_for_its_end() -> None:
    spec = schedule(blackout=[{"begin": "03:05", "end": "04:00"}])
    loop, worker, clock = scheduler(spec)
    asked = []

    def ready() -> str:
        asked.append(clock.now())
        clock.advance(10 * MINUTE)
        return ""

    loop.ready = ready
    loop.run(at("23 03:30"))
    assert worker.done == []
    loop.run(at("23 05:00"))
    assert worker.done == [MON]
    assert asked == [at("23 03:00"), at("23 04:00")]  # and not in the blackout


def test_what_a_blackout_interrupts_is_gone_on_with_after_it() -> None:
    spec = schedule(blackout=[{"begin": "03:01", "end": "04:00"}])
    loop, worker, clock = scheduler(spec)
    asked: list[datetime | None] = []

    @contextmanager
    def guard(moment: datetime | None) -> Iterator[None]:
        asked.append(moment)
        yield
        if moment is not None and clock.now() >= moment:
            raise Interruption

    loop.guard = guard
    loop.run(at("23 05:00"))
    assert worker.done == [MON, MON]
    assert [event for event, _ in events(loop.ledger)[1:]] == ["begun", "deferred", "begun", "done"]
    assert asked == [at("23 03:01"), at("24 03:01")]


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (FitError("too little data"), "FitError"),
        (ZeroDivisionError("zero"), "ZeroDivisionError"),
        (RobotConnectionError("lost"), "RobotConnectionError"),
    ],
)
def test_what_fails_is_noted_and_not_tried_again(error: Exception, kind: str) -> None:
    loop, worker, _ = scheduler(schedule())
    worker.then = [raising(error)]
    loop.run(at("23 12:00"))
    assert worker.done == [MON]
    assert loop.failure is not None
    assert loop.ledger.lines[-1]["kind"] == kind
    loop.run(at("24 12:00"))
    assert events(loop.ledger)[2:] == [("failed", MON), ("begun", TUE), ("done", TUE)]
    assert loop.failure is None


def test_a_robot_that_somebody_took_in_between_is_waited_for() -> None:
    loop, worker, _ = scheduler(schedule())
    busy = ["", "held by pid 7"]
    loop.ready = lambda: busy.pop(0) if busy else ""
    worker.then = [raising(RobotConnectionError("robot ur5 is held by pid 7"))]
    loop.run(at("23 12:00"))
    assert worker.done == [MON, MON]
    told = [event for event, _ in events(loop.ledger)[1:]]
    assert told == ["begun", "deferred", "begun", "done"]


def test_a_clock_that_is_put_back_repeats_nothing(tmp_path: Path) -> None:
    loop, _, _ = scheduler(schedule(), at("24 03:00"), Ledger(tmp_path))
    loop.run_due()
    loop, worker, _ = scheduler(schedule(), at("23 04:00"), Ledger.read(tmp_path))
    loop.run(at("25 04:00"))
    assert worker.done == [WED]


def test_a_signal_while_nothing_is_done_ends_the_loop() -> None:
    loop, _, clock = scheduler(schedule())
    stop = raising(KeyboardInterrupt())
    clock.sleep_until = lambda moment: stop()  # type: ignore[assignment,method-assign]
    with pytest.raises(Stopped) as stopped:
        loop.run()
    assert stopped.value.by_signal


def test_notices_are_of_what_ended_and_may_fail() -> None:
    told: list[Any] = []
    loop, worker, _ = scheduler(schedule(), notify=lambda line: told.append(line) or "no mail")
    worker.then = [raising(FitError("no"))]
    loop.run(at("24 12:00"))
    assert [line["event"] for line in told] == ["failed", "done"]
    noted = [line for line in loop.ledger.lines if line["event"] == "unnotified"]
    assert [(line["occasion"], line["why"]) for line in noted] == [
        (MON, "no mail"),
        (TUE, "no mail"),
    ]


def test_a_schedule_that_is_never_due_again_ends() -> None:
    loop, worker, _ = scheduler(never_due())
    loop.run()
    assert worker.done == []


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10_000), policy=st.sampled_from(["run", "skip"]))
def test_everything_due_is_accounted_for_once(seed: int, policy: str) -> None:
    anything_may_happen(seed, policy)


# A schedule that is held does nothing until a person releases it


HOURLY = {"spec": "p", "every": "1h"}


@pytest.mark.parametrize(
    "error",
    [
        InterlockTripped("elbow: 31 A"),
        RobotFault("protective stop"),
        RobotTimeout("it does not come to rest"),
        StaleState("no data"),
        RobotError("run 3 was tripped: elbow: 31 A"),
        Stopped("somebody said hil stop"),
    ],
)
def test_the_arm_moves_once_and_then_waits_for_a_person(tmp_path: Path, error: Exception) -> None:
    told: list[Any] = []
    with open_ledger(tmp_path, "nightly") as ledger:
        loop, worker, _ = scheduler(schedule(probe=HOURLY), ledger=ledger)
        loop.notify = lambda line: told.append(line) or ""
        worker.then = [raising(error)] * 24
        loop.run(at("24 00:00"))
    with open_ledger(tmp_path, "nightly") as ledger:  # a restart does not let it go on
        loop, again, _ = scheduler(schedule(probe=HOURLY), at("24 00:00"), ledger)
        loop.run(at("25 00:00"))
    assert (len(worker.done), again.done) == (1, [])
    assert events(loop.ledger)[1:] == [
        ("begun", "20261123T000000Z-probe"),
        ("held", "20261123T000000Z-probe"),
    ]
    (line,) = told
    assert (line["event"], line["kind"], line["why"]) == ("held", type(error).__name__, str(error))


def test_once_released_it_goes_on_with_the_latest_that_waited() -> None:
    loop, worker, clock = scheduler(schedule(probe=HOURLY))
    worker.then = [raising(InterlockTripped("elbow: 31 A"))]
    loop.run(at("23 05:30"))
    release(loop.ledger, clock.now(), "a cable was in the way")
    loop.run(at("23 06:30"))
    assert worker.done[1:] == ["20261123T050000Z-probe", "20261123T060000Z-probe"]
    line = next(line for line in loop.ledger.lines if line["event"] == "released")
    assert line["why"] == "a cable was in the way"
    assert line["by"]


def test_somebody_else_holds_and_releases_it_while_it_runs(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly") as ledger:
        loop, worker, clock = scheduler(schedule(), ledger=ledger)
        loop.run(at("23 02:00"))
        hold(Ledger.read(tmp_path), clock.now(), "tool change")
        loop.run(at("23 04:00"))
        assert worker.done == []
        release(Ledger.read(tmp_path), clock.now(), "done")
        loop.run(at("23 04:02"))
        assert worker.done == [MON]
    told = [event for event, _ in events(Ledger.read(tmp_path))]
    assert told == ["started", "held", "released", "begun", "done"]


def test_what_is_held_while_the_robot_is_waited_for_is_not_begun(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly") as ledger:
        loop, worker, clock = scheduler(schedule(), ledger=ledger)

        def ready() -> str:
            hold(Ledger.read(tmp_path), clock.now(), "somebody is at the cell")
            return ""

        loop.ready = ready
        loop.run(at("23 12:00"))
    assert worker.done == []


def test_what_was_cut_off_before_a_hold_is_gone_on_with_after_it() -> None:
    loop, worker, _ = scheduler(schedule())
    worker.then = [raising(Stopped("SIGTERM", by_signal=True))]
    with pytest.raises(Stopped):
        loop.run(at("23 04:00"))
    hold(loop.ledger, at("23 04:00"), "tool change")
    loop, worker, _ = scheduler(schedule(), at("23 05:00"), loop.ledger)
    loop.run(at("23 06:00"))
    assert worker.done == []
    release(loop.ledger, at("23 06:00"), "done")
    loop.run(at("23 07:00"))
    assert worker.done == [MON]


def test_held_twice_and_released_twice_are_told() -> None:
    loop, _, clock = scheduler(schedule())
    with pytest.raises(DataError, match="is not held"):
        release(loop.ledger, clock.now(), "")
    hold(loop.ledger, clock.now(), "tool change")
    with pytest.raises(DataError, match="already held: tool change"):
        hold(loop.ledger, clock.now(), "again")


def test_a_notice_of_a_hold_without_an_occasion_may_fail() -> None:
    loop, _, clock = scheduler(schedule(), at("26 00:00"), notify=lambda line: "no mail")
    loop.run_due()
    clock._moment = at("23 00:00")
    loop.run_due()
    assert events(loop.ledger)[1:] == [("held", ""), ("unnotified", "")]


def test_a_plan_of_a_held_schedule_is_as_if_it_were_released_now() -> None:
    loop, _, clock = scheduler(schedule())
    hold(loop.ledger, clock.now(), "tool change")
    expected = forecast(schedule(), loop.ledger, Motions(), clock.now(), at("25 12:00"))
    assert [one.due for one in expected] == [at("23 03:00"), at("24 03:00"), at("25 03:00")]
    assert loop.ledger.standing.held is not None


@pytest.mark.parametrize("running", [True, False])
def test_a_clock_that_was_years_ahead_holds_it_until_somebody_says_from_when(
    tmp_path: Path, running: bool
) -> None:
    told: list[Any] = []
    years = timedelta(days=3650)
    with open_ledger(tmp_path, "nightly") as ledger:
        loop, worker, clock = scheduler(schedule(), at("23 04:00") + years, ledger)
        loop.run_due()
        loop.run(clock.now() + 24 * HOUR)
        wrong = list(worker.done)
        if not running:
            loop, worker, clock = scheduler(schedule(), at("23 00:00"), Ledger.read(tmp_path))
        clock._moment = at("23 00:00")
        loop.notify = lambda line: told.append(line) or ""
        loop.run(at("23 12:00"))
        assert [line["event"] for line in told] == ["held"]
        assert "the clock shows 2026-11-23T00:00:00+00:00" in told[0]["why"]
        line = release(loop.ledger, at("23 12:00"), "the battery was empty")
        assert (line["anchor"], line["until"]) == ("2026-11-23T12:00:00+00:00",) * 2
        loop.run(at("25 12:00"))
    done = [each for each in worker.done if each not in wrong]
    assert done == [TUE, WED]


def test_a_clock_ahead_for_a_while_changes_nothing_of_when_intervals_count_from() -> None:
    spec = schedule(probe={"spec": "p", "every": "6h"})
    loop, _, clock = scheduler(spec, at("23 01:00"))
    clock._moment = at("30 00:00")
    loop.run_due()
    clock._moment = at("23 02:00")
    loop.run_due()
    release(loop.ledger, clock.now(), "set")
    assert loop.next_moment() == at("23 07:00")


def test_lines_of_several_processes_follow_each_other(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly") as mine:
        mine.start("nightly", at("23 00:00"))
        others = Ledger.read(tmp_path)
        for _ in range(3):
            hold(others, at("23 00:00"), "")
            mine.add("unnotified", at("23 00:00"), why="no mail")
            others.refresh()
            release(others, at("23 00:00"), "")
        mine.refresh()
    assert list(Ledger.read(tmp_path).lines) == mine.lines
    assert (tmp_path / LEDGER_FILE).read_bytes().count(b"\n") == 10


# How real runs end a schedule's occasion: an interlock holds it, Ctrl-C stops at once


class Presses:
    """Presses Ctrl-C when the robot begins to move, and again if that only pauses it."""

    wants_rows = False

    def __init__(self) -> None:
        self.heard: list[str] = []

    def notify(self, event: Mapping[str, Any]) -> None:
        """An event of the run."""
        what = event.get("state", "") if event["kind"] == "state" else event["kind"]
        if what in ("step", "paused") and what not in self.heard:
            self.heard.append(what)
            os.kill(os.getpid(), signal.SIGINT)


def measuring(folder: Path, probe: Any, *observers: Presses) -> Scheduler:
    """A schedule whose work is one real run of a program."""
    write_schedule(folder, probe=probe)
    experiment = load_experiment(folder / "probe.yaml")
    runs = Measuring(folder / "runs", observers=observers)

    def work(occasion: Occasion, _: Path) -> Mapping[str, Any]:
        run = runs.measure(experiment, occasion.id)
        return {"outcome": "quiet", "text": str(run)}

    loop, _, _ = scheduler(schedule(), ledger=Ledger(folder))
    loop.work = work
    return loop


@pytest.mark.thorough
def test_an_interlock_holds_the_schedule(tmp_path: Path) -> None:
    loop = measuring(tmp_path, PROBE | {"interlocks": [{"kind": "current", "limit_a": 0.5}]})
    loop.run(at("25 12:00"))
    assert events(loop.ledger)[1:] == [("begun", MON), ("held", MON)]
    assert loop.ledger.lines[-1]["kind"] == "InterlockTripped"
    assert len(list(tmp_path.glob("runs/*/*/*/start.json"))) == 1


@pytest.mark.thorough
def test_the_first_ctrl_c_stops_what_nobody_attends(tmp_path: Path) -> None:
    presses = Presses()
    loop = measuring(tmp_path, PROBE, presses)
    with pytest.raises(Stopped) as stopped:
        loop.run(at("24 00:00"))
    assert stopped.value.by_signal
    assert presses.heard == ["step"]
    assert events(loop.ledger)[1:] == [("begun", MON)]  # and is gone on with at the next start


# kill -9 at random moments of the loop: what is due is done once, or it is said why not


KILLS = 2


@pytest.mark.thorough
def test_a_kill_loses_nothing_and_repeats_nothing(tmp_path: Path) -> None:
    killed_at_random(tmp_path, KILLS, seed=3)
