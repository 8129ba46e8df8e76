"""Runs that end early, and what of them was measured."""

from __future__ import annotations

import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest

import hil
from hil.engine import Engine, Reply
from hil.importers.completeness import completeness_of
from hil.planning.plan import Plan
from hil.recording import RunDirectory
from hil.workflow import operator

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 2}
reference: {every: 2}
accept: {gaps_percent: {max: 50}}
"""


class Noted:
    """An observer that keeps what it is told."""

    def __init__(self, told: list[dict[str, Any]]) -> None:
        self.notify = told.append


def small_spec(folder: Path, text: str = SPEC) -> Path:
    path = folder / "small.yaml"
    path.write_text(text, "utf-8")
    return path


class StopsAt:
    """Asks a run to stop when a step begins; observers are told before it is executed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, step: int) -> None:
        self.step = step
        original = Engine._execute

        def stopping(engine: Engine, step: Any) -> None:
            if step.index == self.step:
                engine.request_stop("the test wants it")
            original(engine, step)

        monkeypatch.setattr(Engine, "_execute", stopping)


@functools.cache
def _kept() -> tempfile.TemporaryDirectory[str]:
    """Return the folder of such runs; it goes with the process."""
    return tempfile.TemporaryDirectory(prefix="stopped-runs-")


@functools.cache
def _stopped_once(step: int, text: str) -> tuple[Path, Path]:
    """Return a run that was stopped at a step, and the folder it is in; nothing changes it."""
    home = Path(tempfile.mkdtemp(dir=_kept().name))
    with pytest.MonkeyPatch.context() as patch:
        return home, stopped_run(home, patch, step, text)


def copy_of_stopped(folder: Path, step: int, text: str = SPEC) -> Path:
    """Return a copy, in a folder, of the run of an unchanged mock that was stopped at a step."""
    home, run = _stopped_once(step, text)
    shutil.copytree(home, folder, dirs_exist_ok=True)
    return folder / run.relative_to(home)


def stopped_run(folder: Path, monkeypatch: pytest.MonkeyPatch, step: int, text: str = SPEC) -> Path:
    with monkeypatch.context() as patch:
        StopsAt(patch, step)
        report = hil.run(hil.load(small_spec(folder, text)), runs=folder / "runs")
    assert report.outcome == "stopped"
    return report.run


def plan_of(run: Path) -> Plan:
    return Plan.from_dict(json.loads((run / "plan.json").read_text("utf-8")))


def measured(run: Path) -> set[int]:
    return set(completeness_of(plan_of(run), RunDirectory.open(run).recordings).done)


class Told:
    """Notes what the robot and the operator are told, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.said: list[str] = []
        from hil_mock_robot.embedded.robot import MockRobot

        set_payload = MockRobot.set_payload

        def declared(robot: MockRobot, payload: Any) -> Any:
            self.said.append(f"{payload.mass:g} kg")
            return set_payload(robot, payload)

        def asked(text: str, meanwhile: Any) -> Reply:
            self.said.append(text)
            return Reply(yes=True, who="Ada")

        monkeypatch.setattr(MockRobot, "set_payload", declared)
        monkeypatch.setattr(operator, "answer_as_mock", asked)


def plan_of_spec(folder: Path, text: str) -> Plan:
    path = folder / "plan.yaml"
    path.write_text(text, "utf-8")
    return hil.plan(hil.load(path))
