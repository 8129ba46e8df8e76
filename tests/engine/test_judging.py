"""Interlocks of others: one that raises, dawdles or hangs is named, and not the driver."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from hil.core.errors import InterlockTripped
from hil.core.typing import StructArray
from hil.engine import Outcome
from hil.engine.reading import SLOW_S, Judge
from hil.robot import Capabilities
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot


class Foreign:
    """An interlock of somebody's package; does what it is told to in `check`."""

    action = "stop"

    def __init__(self, name: str, does: Any) -> None:
        self.name = name
        self._does = does

    def check(self, block: StructArray) -> Any:
        return self._does(block)

    def clear(self, block: StructArray) -> bool:
        return True


def boo(block: StructArray) -> None:
    raise ValueError("boo")


@pytest.mark.thorough
def test_an_interlock_that_raises_is_named_with_its_place() -> None:
    robot = KinematicRobot()
    result = engine(robot, ListSink(), interlocks=[Foreign("raiser", boo)]).run()
    assert result.outcome is Outcome.TRIPPED
    assert result.reason == "interlock raiser: ValueError: boo"
    assert result.error is not None
    assert "tests.engine.test_judging.Foreign" in result.error.hint
    assert f"{__file__}:" in result.error.hint
    assert result.notes == ()
    assert "stop" in robot.calls


def test_what_is_no_trip_is_none() -> None:
    says_true = Foreign("handmade", lambda block: True)
    result = engine(KinematicRobot(), ListSink(), interlocks=[says_true]).run()
    assert result.reason == "interlock handmade: check returned True, which is no Trip"


def test_an_interlock_that_dawdles_is_named_at_the_end() -> None:
    clock = iter([0.0, 5.0, 5.0, 5.0 + 2 * SLOW_S, 6.0, 6.0 + SLOW_S / 2])
    judge = Judge([Foreign("sleeper", lambda block: None)], now=lambda: next(clock))
    for _ in range(3):
        assert list(judge.violations(ListSink)) == []  # type: ignore[arg-type]
    assert judge.notes == ["interlock sleeper took up to 0.5 s for one block: it must not wait"]


class WallRobot(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        own = super().capabilities
        return Capabilities(own.joint_names, own.rate_hz, own.effort_kind, clock="wall")


@pytest.mark.thorough
def test_an_interlock_that_hangs_is_named_and_not_the_driver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from hil.engine import watchdog

    monkeypatch.setattr(watchdog.Watchdog.__init__, "__kwdefaults__", {"limit_s": 0.2, "on": True})
    for_ever = threading.Event()
    hangs = Foreign("light curtain", lambda block: for_ever.wait(20) and None)
    begin = time.monotonic()
    result = engine(WallRobot(), ListSink(), interlocks=[hangs]).run()
    for_ever.set()
    assert time.monotonic() - begin < 15
    assert isinstance(result.error, InterlockTripped)
    assert result.reason == "interlock light curtain: it did not return for seconds"
    assert "the watchdog stopped the robot" in result.notes[0]
