"""A stop that comes while the drives are being connected leaves them off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from hil.core.errors import CommandRefused
from hil_drivers.cia402.axes_robot import AxesRobot
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.session import Session

GIVEN = {"bus": {"interface": "hil_unix", "channel": "nobody"}}
STEPS = ["join", "open", "operational", "run", "reset_faults", "enable", "look", "switch", "ask"]
STEPS += ["forget"]


class Steps:
    """Plays a session: notes what is done, and has something happen at one step."""

    def __init__(self, at: str, happens: Any) -> None:
        self.done: list[str] = []
        self._at, self._happens = at, happens

    def step(self, name: str) -> Any:
        def do(*_: Any, **__: Any) -> None:
            self.done.append(name)
            if name == self._at:
                self._happens()

        return do

    def session(self, *_: Any) -> Any:
        self.step("join")()
        core = {name: self.step(name) for name in STEPS} | {"stop": lambda _: None}
        made = object.__new__(Session)
        made.core = SimpleNamespace(**core)  # type: ignore[assignment]
        made.acyclic = SimpleNamespace(operational=self.step("operational"), n=6)  # type: ignore[assignment]
        made.options = SimpleNamespace(trajectory_mode="cst", stop_rad_s2=1.0)  # type: ignore[assignment]
        made.mapping, made.faults_reset = MAPPINGS["position"], [object()]  # type: ignore[list-item]
        made.leave = self.step("leave")  # type: ignore[method-assign]
        made.require_plausible_torques = self.step("look")  # type: ignore[method-assign]
        made.thermometer = SimpleNamespace(ask_all=self.step("ask"))  # type: ignore[assignment]
        made.samples = SimpleNamespace(forget=self.step("forget"))  # type: ignore[assignment]
        made.trouble = SimpleNamespace(is_there=False)  # type: ignore[assignment]
        return made


@pytest.mark.parametrize("at", STEPS)
def test_a_stop_at_any_step_refuses_and_leaves_the_axes_off(monkeypatch, at: str) -> None:
    robot = AxesRobot("arm", "lab6", **GIVEN)
    steps = Steps(at, robot.stop)
    monkeypatch.setattr(robot, "_join", steps.session)
    with pytest.raises(CommandRefused, match="stopped while connecting"):
        robot.connect()
    assert steps.done[-1] == "leave"
    if STEPS.index(at) < STEPS.index("enable"):
        assert "enable" not in steps.done
    assert steps.done.count("switch") == (at in STEPS[STEPS.index("switch") :])


def test_a_robot_that_was_stopped_before_is_connected(monkeypatch) -> None:
    robot = AxesRobot("arm", "lab6", **GIVEN)
    steps = Steps("nowhere", robot.stop)
    monkeypatch.setattr(robot, "_join", steps.session)
    robot.stop()
    robot.connect()
    assert steps.done == STEPS
