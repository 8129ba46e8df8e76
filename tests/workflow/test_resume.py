"""A run that ended early goes on: nothing whole is measured again, nothing is left out."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.core.errors import DataError, PreflightFailed, RecordingError
from hil.engine import Engine, Reply
from hil.importers import completeness
from hil.importers.completeness import completeness_of
from hil.importers.sources import load_source
from hil.planning.plan import Plan
from hil.recording.mcap_reader import read_topic
from hil.recording.recorder import Recorder
from hil.recording.run_directory import RunDirectory
from hil.workflow import operator, resuming
from hil.workflow.judging import TRAINING
from hil.workflow.live_state import LIVE_FILE, read_live
from hil.workflow.remote_control import stop_run

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 2}
reference: {every: 2}
accept: {gaps_percent: {max: 50}}
"""
FITTED = SPEC.replace("waypoints: 4", "waypoints: 12") + "fit: [{estimator: static-wls}]\n"


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


def all_steps(run: Path) -> set[int]:
    return {step.index for step in plan_of(run) if step.measures}


def torn(run: Path, keep: float) -> None:
    """What a kill leaves: no stop document, and a recording that ends anywhere."""
    directory = RunDirectory.open(run)
    last = directory.attempts - 1
    name = f"stop-{last:02d}.json" if last else "stop.json"
    (run / name).unlink(missing_ok=True)
    for extra in ("verdict.json", "report.html"):
        (run / extra).unlink(missing_ok=True)
    file = directory.recordings[-1]
    data = file.read_bytes()
    file.unlink()
    partial = file.with_name(file.name.removesuffix(".partial") + ".partial")
    partial.write_bytes(data[: int(keep * len(data))])


@pytest.mark.thorough
def test_a_stopped_run_goes_on_and_is_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30, text=FITTED)
    before = measured(run)
    assert before
    assert before < all_steps(run)
    told: list[dict[str, Any]] = []
    report = hil.resume(run, observers=[Noted(told)])
    assert report.error is None
    stages = [event["stage"] for event in told if event["kind"] == "stage"]
    assert [text.partition(",")[0] for text in stages if "on purpose" in text] == [
        "warming up again"
    ]
    assert {event["resumed"] for event in told if event["kind"] == "progress"} == {1}
    assert report.outcome == "completed"
    assert report.run == run
    assert measured(run) == all_steps(run)
    assert (run / "verdict.json").exists()
    stop = RunDirectory.open(run).stop
    assert stop is not None
    assert stop["complete"]["dwell"] == {"done": 24, "of": 24}
    assert RunDirectory.open(run).status == "completed"
    assert not RunDirectory.open(run).verify()


@pytest.mark.thorough
def test_the_view_of_an_attempt_that_died_is_not_how_the_next_one_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    (run / LIVE_FILE).write_text(json.dumps({"state": "done", "prompt": "Mount it"}), "utf-8")
    seen: list[dict[str, Any]] = []

    def looked(run: Path) -> None:
        seen.append(read_live(run))
        stop_run(run, who="anna", wait_s=0)  # taken while the way back is still to be planned
        raise DataError("enough")

    monkeypatch.setattr(resuming, "open_unfinished", looked)
    with pytest.raises(DataError, match="enough"):
        hil.resume(run)
    assert seen == [{}]
    assert list(run.glob(".control")) == []


@pytest.mark.thorough
def test_what_was_whole_is_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    before = measured(run)
    hil.resume(run)
    first, second = (read_topic(path) for path in RunDirectory.open(run).recordings)
    again = set(np.unique(second["segment"]).tolist()) & before
    assert not again
    assert set(np.unique(first["segment"]).tolist()) >= before


@pytest.mark.thorough
def test_the_dataset_of_a_resumed_run_has_every_dwell_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=31)
    hil.resume(run)
    data = load_source(run, ("dwell",))
    counted = Counter((c.pose, c.approach) for c in data.conditions)
    assert set(counted.values()) == {1}
    assert len(counted) == 8


@pytest.mark.thorough
def test_files_of_the_first_attempt_stay_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    kept = {p: p.read_bytes() for p in run.rglob("*") if p.is_file() and p.suffix != ".html"}
    hil.resume(run)
    for path, content in kept.items():
        assert path.read_bytes()[: len(content)] == content
    names = {path.name for path in run.iterdir()}
    assert {"resume-01.json", "preflight-01.json", "stop-01.json"} <= names


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_any_number_of_stops_kills_and_resumes_measures_the_same_as_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    chance = random.Random(seed)
    run = stopped_run(tmp_path, monkeypatch, step=chance.randrange(5, 30))
    for _ in range(3):
        if chance.random() < 0.6:
            torn(run, keep=chance.uniform(0.05, 0.99))
        whole = measured(run)
        with monkeypatch.context() as patch:
            left = sorted(all_steps(run) - whole)
            StopsAt(patch, step=chance.choice(left))
            report = hil.resume(run)
        assert report.outcome == "stopped"
        assert measured(run) >= whole
    report = hil.resume(run)
    assert report.outcome == "completed"
    assert measured(run) == all_steps(run)
    counted = Counter((c.pose, c.approach) for c in load_source(run, ("dwell",)).conditions)
    assert sorted(counted.values()) == [1] * 8


@pytest.mark.thorough
def test_a_run_whose_fit_was_killed_is_fitted_without_moving(tmp_path: Path) -> None:
    report = hil.run(hil.load(small_spec(tmp_path, FITTED)), runs=tmp_path / "runs")
    for path in sorted(report.run.glob("fit/*/*")):
        path.unlink()
    for name in ("verdict.json", "report.html"):
        (report.run / name).unlink()
    again = hil.resume(report.run)
    assert again.outcome == "completed"
    assert (report.run / "verdict.json").exists()
    assert len(RunDirectory.open(report.run).recordings) == 1


@pytest.mark.thorough
def test_trainings_that_a_kill_left_after_the_verdict_are_forgotten(tmp_path: Path) -> None:
    run = hil.run(hil.load(small_spec(tmp_path, FITTED)), runs=tmp_path / "runs").run
    (run / TRAINING / "lagrangian-0123456789ab").mkdir(parents=True)
    with pytest.raises(DataError, match="judged"):
        hil.resume(run)
    assert not (run / TRAINING).exists()


@pytest.mark.thorough
def test_nobody_else_resumes_a_run_that_is_being_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    refused: list[str] = []
    held = resuming.held

    @contextlib.contextmanager
    def meanwhile(*arguments: Any, **options: Any) -> Iterator[Any]:
        # The first one has read what is missing and waits for its robot.
        with pytest.raises(DataError, match="is live") as caught:
            hil.resume(run)
        refused.append(str(caught.value))
        with held(*arguments, **options) as robot:
            yield robot

    monkeypatch.setattr(resuming, "held", meanwhile)
    assert hil.resume(run).outcome == "completed"
    assert len(refused) == 1
    assert RunDirectory.open(run).attempts == 2


@pytest.mark.thorough
def test_a_complete_run_has_nothing_to_go_on_with(tmp_path: Path) -> None:
    report = hil.run(hil.load(small_spec(tmp_path)), runs=tmp_path / "runs")
    with pytest.raises(DataError, match="complete"):
        hil.resume(report.run)


@pytest.mark.thorough
def test_another_plan_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    plan = json.loads((run / "plan.json").read_text("utf-8"))
    plan["loads"][0]["mass_kg"] = 3.0
    (run / "plan.json").write_text(json.dumps(plan), "utf-8")
    with pytest.raises(DataError, match=r"plan\.json is not what the run was begun with"):
        hil.resume(run)


@pytest.mark.thorough
def test_another_robot_is_refused_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    station = json.loads((run / "station.yaml").read_text("utf-8").partition("\n")[2])
    station["robots"]["ur5"]["options"] = {"seed": 5}
    (run / "station.yaml").write_text(json.dumps(station), "utf-8")
    files = sorted(run.rglob("*"))
    with pytest.raises(PreflightFailed, match="serial"):
        hil.resume(run)
    assert sorted(run.rglob("*")) == files


@pytest.mark.thorough
def test_a_run_that_ended_before_its_plan_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    (run / "plan.json").unlink()
    with pytest.raises(DataError, match=r"no plan\.json"):
        hil.resume(run)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [0, 8, 200, 3000])
def test_a_kill_before_the_first_sample_costs_nothing_but_that_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=8)
    torn(run, keep=1.0)
    file = RunDirectory.open(run).recordings[0]
    file.write_bytes(file.read_bytes()[:size])
    assert hil.resume(run).outcome == "completed"
    assert len(load_source(run, ("dwell",)).conditions) == 8


LOADS = """
hil: 1
name: sweep
robot: ur5
excitation: {kind: dwell, waypoints: 1, approach: positive, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
weigh: false
loads: [{mass_kg: 0}, {mass_kg: 2, prompt: "Mount 2 kg"}]
"""


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


@pytest.mark.thorough
def test_no_other_load_is_declared_before_the_one_in_force_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = len(plan_of_spec(tmp_path, LOADS)) - 1
    run = stopped_run(tmp_path, monkeypatch, step=last, text=LOADS)
    told = Told(monkeypatch)
    hil.resume(run)
    assert told.said == ["Mount 2 kg", "2 kg"]


@pytest.mark.thorough
def test_going_back_to_an_earlier_load_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of_spec(tmp_path, LOADS)
    run = stopped_run(tmp_path, monkeypatch, step=len(plan) - 1, text=LOADS)
    dwell = next(step.index for step in plan if step.kind == "dwell")
    monkeypatch.setattr(completeness, "step_is_complete", lambda step, *_: step.index > dwell)
    told = Told(monkeypatch)
    hil.resume(run)
    assert told.said[0].startswith("Take the load off again")
    assert told.said[1:] == ["0 kg", "Mount 2 kg", "2 kg"]


def plan_of_spec(folder: Path, text: str) -> Plan:
    path = folder / "plan.yaml"
    path.write_text(text, "utf-8")
    return hil.plan(hil.load(path))


@pytest.mark.thorough
def test_motion_that_came_to_its_end_without_its_data_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        put = Recorder.put

        def loses(recorder: Recorder, topic: str, rows: Any) -> None:
            kept = rows[(rows["segment"] < 20) | (rows["segment"] > 30)]
            put(recorder, topic, kept)

        patch.setattr(Recorder, "put", loses)
        report = hil.run(hil.load(small_spec(tmp_path)), runs=tmp_path / "runs")
    assert report.outcome == "failed"
    assert isinstance(report.error, RecordingError)
    assert "hil resume" in report.error.hint
    assert not (report.run / "verdict.json").exists()
    again = hil.resume(report.run)
    assert again.outcome == "completed"
    assert measured(report.run) == all_steps(report.run)


@pytest.mark.thorough
def test_another_mounting_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = stopped_run(tmp_path, monkeypatch, step=30)
    station = json.loads((run / "station.yaml").read_text("utf-8").partition("\n")[2])
    station["robots"]["ur5"]["gravity_m_s2"] = [0.0, 0.0, 9.81]
    (run / "station.yaml").write_text(json.dumps(station), "utf-8")
    with pytest.raises(PreflightFailed, match="gravity"):
        hil.resume(run)


@pytest.mark.wire
def test_a_run_killed_with_9_is_resumed_from_the_command_line(tmp_path: Path) -> None:
    spec = small_spec(tmp_path, SPEC.replace("waypoints: 4", "waypoints: 60"))
    hil_command = [sys.executable, "-m", "hil"]
    runs = ["--runs", str(tmp_path / "runs")]
    environment = {**os.environ, "HIL_STATION": ""}
    running = subprocess.Popen(
        [*hil_command, "run", str(spec), *runs],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
    )
    give_up = time.monotonic() + 60
    while not list(tmp_path.glob("runs/*/*/*/recording/*.partial")):
        assert time.monotonic() < give_up
        time.sleep(0.02)
    time.sleep(0.7)
    running.send_signal(signal.SIGKILL)
    running.communicate(timeout=30)
    (run,) = tmp_path.glob("runs/*/*/*")
    assert RunDirectory.open(run).status == "interrupted"
    done = subprocess.run(
        [*hil_command, "resume", str(run), "--json"],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["outcome"] == "completed"
    assert measured(run) == all_steps(run)
