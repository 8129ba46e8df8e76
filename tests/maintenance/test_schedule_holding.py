"""A schedule that is held does nothing until a person releases it."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import (
    DataError,
    InterlockTripped,
    RobotError,
    RobotFault,
    RobotTimeout,
    StaleState,
    Stopped,
)
from hil.maintenance.dry_run import Motions, forecast
from hil.maintenance.ledger import LEDGER_FILE, Ledger, hold, open_ledger, release
from tests.support.schedule_parts import HOUR, at, events, raising, schedule, scheduler

MON, TUE, WED = (f"202611{day}T030000Z-probe" for day in (23, 24, 25))
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
    with pytest.raises(DataError, match="held already: tool change"):
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
