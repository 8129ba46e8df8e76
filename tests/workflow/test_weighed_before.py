"""A sweep that is resumed: is the first load the one that was measured with?"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.core.errors import PreflightFailed
from hil.planning.plan import Plan, Step
from hil.recording.recorder import Recorder
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities
from hil.workflow.payload_check import all_reliable, readings_of_earlier_attempts
from hil.workflow.running import RunReport
from hil_mock_robot.embedded.robot import MockRobot
from tests.workflow.test_resume import Noted, Told, measured, plan_of, plan_of_spec, stopped_run

SWEEP = """
hil: 1
name: sweep
robot: ur5
excitation: {kind: dwell, waypoints: 2, approach: positive, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
weigh: {poses: 1}
loads: [{mass_kg: 0, prompt: "Remove everything"}, {mass_kg: 3, prompt: "Mount 3 kg"}]
"""
WAIVED = {"weighing": "the test wants it"}


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return plan_of_spec(tmp_path, SWEEP)


def mounts(patch: pytest.MonkeyPatch, really: Callable[[Payload], Payload]) -> None:
    """Whatever is declared, `really` hangs there."""
    original = MockRobot.set_payload

    def set_payload(robot: MockRobot, payload: Payload) -> Payload:
        back = original(robot, payload)
        robot._arm.on.set_payloads(really(payload), payload)
        return back

    patch.setattr(MockRobot, "set_payload", set_payload)


def loses(patch: pytest.MonkeyPatch, step: Step, keeping: int = 0) -> None:
    """The recording has nothing of a step but its first samples."""
    put, seen = Recorder.put, 0

    def keep(recorder: Recorder, topic: str, rows: Any) -> None:
        nonlocal seen
        own = rows["segment"] == step.index
        kept = ~own | (seen + np.cumsum(own) <= keeping)
        seen += int(own.sum())
        put(recorder, topic, rows[kept])

    patch.setattr(Recorder, "put", keep)


def of_load(plan: Plan, load: int, kind: str) -> list[Step]:
    return [step for step in plan if step.kind == kind and step.load == load]


def weighings(run: Path) -> list[tuple[int, str]]:
    events = RunDirectory.open(run).events()
    return [(e["load"], e["result"]) for e in events if e["kind"] == "weighing"]


def left_on(declared: Payload) -> Payload:
    return declared if declared.mass else Payload(3.0, (0.0, 0.0, 0.05))


def resume_with_load_left_on(run: Path, **options: Any) -> RunReport:
    with pytest.MonkeyPatch.context() as patch:
        mounts(patch, left_on)
        return hil.resume(run, **options)


def earlier(run: Path) -> Any:
    directory, plan = RunDirectory.open(run), plan_of(run)
    can = Capabilities(plan.joint_names, plan.rate_hz, "torque", ())
    return readings_of_earlier_attempts(plan, directory.recordings, can)


@pytest.mark.thorough
def test_the_right_load_passes_and_the_run_is_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = stopped_run(tmp_path, monkeypatch, of_load(plan, 0, "dwell")[1].index, SWEEP)
    told: list[dict[str, Any]] = []
    assert hil.resume(run, observers=[Noted(told)]).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "passed"), (1, "passed")]
    assert any(str(event.get("stage")).startswith("weighing again, on purpose") for event in told)


@pytest.mark.thorough
def test_a_load_left_on_is_found_and_taking_it_off_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = stopped_run(tmp_path, monkeypatch, of_load(plan, 0, "dwell")[1].index, SWEEP)
    done = measured(run)
    report = resume_with_load_left_on(run)
    assert isinstance(report.error, PreflightFailed)
    assert report.error.message.startswith("weighing: load 0: 0.00 kg declared, ")
    assert measured(run) == done
    # What failed is no reference for the next attempt.
    assert hil.resume(run).outcome == "completed"
    assert weighings(run)[1:] == [(0, "failed"), (0, "passed"), (1, "passed")]


@pytest.mark.thorough
def test_a_load_left_on_can_be_waived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = stopped_run(tmp_path, monkeypatch, of_load(plan, 0, "dwell")[1].index, SWEEP)
    assert resume_with_load_left_on(run, waivers=WAIVED).outcome == "completed"
    assert weighings(run)[1] == (0, "waived")


@pytest.mark.thorough
def test_a_first_load_nothing_was_measured_with_may_be_put_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    with monkeypatch.context() as patch:
        mounts(patch, left_on)
        run = stopped_run(tmp_path, patch, of_load(plan, 0, "weigh")[-1].index + 1, SWEEP)
    assert earlier(run) == {}
    assert hil.resume(run).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "first"), (1, "passed")]


@pytest.mark.thorough
def test_a_first_load_that_was_weighed_and_measured_is_not_mounted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = stopped_run(tmp_path, monkeypatch, of_load(plan, 1, "dwell")[1].index, SWEEP)
    assert all_reliable(earlier(run))
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Mount 3 kg", "3 kg"]


def run_without_its_weighing(folder: Path, patch: pytest.MonkeyPatch, plan: Plan) -> Path:
    with patch.context() as lossy:
        loses(lossy, of_load(plan, 0, "weigh")[0])
        return stopped_run(folder, lossy, of_load(plan, 1, "dwell")[1].index, SWEEP)


@pytest.mark.thorough
def test_a_first_load_whose_weighing_is_lost_is_mounted_and_weighed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = run_without_its_weighing(tmp_path, monkeypatch, plan)
    done = measured(run)
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Remove everything", "0 kg", "Mount 3 kg", "3 kg"]
    assert weighings(run)[2:] == [(0, "inconclusive"), (1, "passed")]
    assert not done & set(json.loads((run / "resume-01.json").read_text("utf-8"))["steps"])


@pytest.mark.thorough
def test_a_first_load_weighed_for_the_others_alone_is_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = run_without_its_weighing(tmp_path, monkeypatch, plan)
    with monkeypatch.context() as patch:
        mounts(patch, lambda declared: Payload())
        assert isinstance(hil.resume(run).error, PreflightFailed)
    assert all_reliable(earlier(run))
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Mount 3 kg", "3 kg"]


@pytest.mark.thorough
def test_a_torn_weighing_that_was_measured_after_is_said_and_no_reason_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    with monkeypatch.context() as lossy:
        loses(lossy, of_load(plan, 0, "weigh")[0], keeping=60)
        run = stopped_run(tmp_path, lossy, of_load(plan, 0, "dwell")[1].index, SWEEP)
    assert hil.resume(run).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "inconclusive"), (1, "passed")]
    page = " ".join((run / "report.html").read_text("utf-8").split())
    assert "in an earlier attempt cannot be read (at weighing pose 1 from below, the" in page
