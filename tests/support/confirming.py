"""A real robot that is not there, and somebody who confirms its motion."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

import hil
import hil.arms
from hil.engine import Engine, Reply, nobody_goes_on
from hil.robot import Address
from hil.workflow import motion_confirmation
from hil.workflow.console import Console
from hil.workflow.operator import OperatorChannel
from hil.workflow.running import RunReport
from hil_mock_robot.embedded.robot import MockRobot

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 2}
loads: [{mass_kg: 1.5, com_m: [0, 0, 0.05]}]
weigh: {poses: 0}
accept: {gaps_percent: {max: 50}}
"""


STATION = """
hil_station: 1
robots:
  ur5:
    driver: mock
    model: ur5
    checklist: [The emergency stop is within reach., Nobody is near.]
"""


AT, ELSEWHERE = "198.51.100.7", "198.51.100.8"


class FakeConsole(Console):
    """Types the given lines, one a look, and keeps what it is shown."""

    def __init__(self, *typed: str | None, there: bool = True) -> None:
        super().__init__()
        self.typed = list(typed)
        self.there = there
        self.shown: list[str] = []
        self.on_line: Callable[[], object] = lambda: None

    @property
    def present(self) -> bool:
        return self.there

    def forget_typed(self) -> None:
        """What was typed before does not count; nothing was."""

    def line(self, wait_s: float) -> str | None:
        self.on_line()
        return self.typed.pop(0) if self.typed else None

    def say(self, *paragraphs: str, ask: str = "") -> None:
        self.shown += [*paragraphs, ask]

    def show(self, lines: Iterable[str]) -> None:
        self.shown += lines


def desk(confirm: motion_confirmation.Confirm) -> OperatorChannel:
    return OperatorChannel(
        lambda text, meanwhile: Reply(True, "anna"), nobody_goes_on, confirm=confirm
    )


def run(experiment: hil.Experiment, confirm: motion_confirmation.Confirm) -> RunReport:
    return hil.run(experiment, runs=experiment.folder / "runs", desk=desk(confirm))


def document(report: RunReport, name: str = "start.json") -> dict[str, Any]:
    out: dict[str, Any] = json.loads((report.run / name).read_text("utf-8"))
    return out


def stopped(
    experiment: hil.Experiment,
    monkeypatch: pytest.MonkeyPatch,
    confirm: motion_confirmation.Confirm,
) -> RunReport:
    """A run that somebody stopped after its first measurements."""
    original = Engine._execute

    def stopping(engine: Engine, step: Any) -> None:
        if step.index == 8:
            engine.request_stop("the test wants it")
        original(engine, step)

    with monkeypatch.context() as patch:
        patch.setattr(Engine, "_execute", stopping)
        report = run(experiment, confirm)
    assert report.outcome == "stopped"
    return report


def cut_off_at(folder: Path) -> Path:
    """Return the run, in a new folder, of an arm at AT that was confirmed there and stopped."""
    (folder / "small.yaml").write_text(SPEC, "utf-8")
    (folder / "station.yaml").write_text(STATION, "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        stand_at(AT, patch)
        return stopped(
            hil.load(folder / "small.yaml"), patch, motion_confirmation.Granted("--yes")
        ).run


def stand_at(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Declare the embedded mock to be a real arm at an address."""
    monkeypatch.setattr(MockRobot, "address", Address(address))


def jogged(run: Path) -> None:
    """Let the arm of a run stand where its program never takes it."""
    station = run / "station.yaml"
    options = "driver: mock\n    options: {start_q_deg: [-150, -60, -100, -60, 120, 170]}"
    station.write_text(station.read_text("utf-8").replace("driver: mock", options), "utf-8")


REAL_ARM = """
from hil.robot import Address
from hil_mock_robot.embedded.robot import MockRobot


class RealArm(MockRobot):
    def __init__(self, name, model, *, at, **options):
        super().__init__(name, model, **options)
        self.address = Address(at)
"""
