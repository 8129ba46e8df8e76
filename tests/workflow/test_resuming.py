"""A run that ended early goes on: nothing whole is measured again, nothing is left out."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import hil
from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, FitError, PreflightFailed, RecordingError, Rejected
from hil.core.typing import FloatArray
from hil.excitation.motion import Hold, Line
from hil.importers import completeness
from hil.importers.sources import load_source
from hil.planning.plan import LoadStep, Plan, Step
from hil.recording import McapWriter, RunDirectory, read_topic
from hil.recording.recorder import Recorder
from hil.recording.recovery import recover
from hil.recording.run_directory import RESERVE, reserve
from hil.robot.state import state_topic
from hil.runs.listing import list_runs
from hil.workflow import resuming
from hil.workflow.judging import TRAINING
from hil.workflow.live_state import LIVE_FILE, read_live
from hil.workflow.remote_control import stop_run
from hil.workflow.resuming import connected_steps, legs_of, remaining_steps
from hil.workflow.running import RunReport
from tests.support.report_runs import dwell_plan, write_run
from tests.support.resuming import (
    SPEC,
    Noted,
    StopsAt,
    Told,
    copy_of_stopped,
    measured,
    plan_of,
    plan_of_spec,
    small_spec,
)
from tests.support.study_parts import register
from tests.support.waiting import until

pytestmark = pytest.mark.usefixtures("plans_once")

FITTED = SPEC.replace("waypoints: 4", "waypoints: 12") + "fit: [{estimator: static-wls}]\n"


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


@dataclass(frozen=True)
class GoneOn:
    """A run that was stopped and then resumed to its end: what it was before, and its events."""

    report: RunReport
    before: set[int]
    files: dict[Path, bytes]
    events: list[dict[str, Any]]


@pytest.fixture(scope="module")
def gone_on(tmp_path_factory: pytest.TempPathFactory) -> GoneOn:
    """Such a run; nothing changes it."""
    run = copy_of_stopped(tmp_path_factory.mktemp("gone-on"), step=30, text=FITTED)
    files = {p: p.read_bytes() for p in run.rglob("*") if p.is_file() and p.suffix != ".html"}
    before, events = measured(run), list[dict[str, Any]]()
    assert before
    assert before < all_steps(run)
    return GoneOn(hil.resume(run, observers=[Noted(events)]), before, files, events)


@pytest.mark.thorough
def test_a_stopped_run_goes_on_and_is_judged(gone_on: GoneOn) -> None:
    report, run = gone_on.report, gone_on.report.run
    assert report.error is None
    stages = [event["stage"] for event in gone_on.events if event["kind"] == "stage"]
    assert [text.partition(",")[0] for text in stages if "again" in text] == ["warming up again"]
    assert {one["resumed"] for one in gone_on.events if one["kind"] == "progress"} == {1}
    assert report.outcome == "completed"
    assert set(gone_on.files) <= set(run.rglob("*"))
    assert measured(run) == all_steps(run)
    assert (run / "verdict.json").exists()
    stop = RunDirectory.open(run).stop
    assert stop is not None
    assert stop["complete"]["dwell"] == {"done": 24, "of": 24}
    assert RunDirectory.open(run).status == "completed"
    assert not RunDirectory.open(run).verify()


@pytest.mark.thorough
def test_what_was_whole_is_not_measured_again(gone_on: GoneOn) -> None:
    first, second = map(read_topic, RunDirectory.open(gone_on.report.run).recordings)
    again = set(np.unique(second["segment"]).tolist()) & gone_on.before
    assert not again
    assert set(np.unique(first["segment"]).tolist()) >= gone_on.before
    data = load_source(gone_on.report.run, ("dwell",))
    counted = Counter((c.pose, c.approach) for c in data.conditions)
    assert sorted(counted.values()) == [1] * 24


@pytest.mark.thorough
def test_files_of_the_first_attempt_stay_as_they_were(gone_on: GoneOn) -> None:
    for path, content in gone_on.files.items():
        assert path.read_bytes()[: len(content)] == content
    names = {path.name for path in gone_on.report.run.iterdir()}
    assert {"resume-01.json", "preflight-01.json", "stop-01.json"} <= names


@pytest.mark.thorough
def test_the_view_of_an_attempt_that_died_is_not_how_the_next_one_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copy_of_stopped(tmp_path, step=30)
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
@pytest.mark.parametrize("seed", [0])  # of many kills: tests/proofs/kill_whole_runs.py
def test_any_number_of_stops_kills_and_resumes_measures_the_same_as_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    chance = random.Random(seed)
    run = copy_of_stopped(tmp_path, step=chance.randrange(5, 30))
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
def test_nobody_else_resumes_a_run_that_is_being_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copy_of_stopped(tmp_path, step=30)
    refused: list[str] = []
    held = resuming.held

    @contextlib.contextmanager
    def meanwhile(*arguments: Any, **options: Any) -> Iterator[Any]:
        # The first one has read what is missing and waits for its robot.
        with pytest.raises(DataError, match="is active") as caught:
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
def test_another_plan_is_refused(tmp_path: Path) -> None:
    run = copy_of_stopped(tmp_path, step=30)
    plan = json.loads((run / "plan.json").read_text("utf-8"))
    plan["loads"][0]["mass_kg"] = 3.0
    (run / "plan.json").write_text(json.dumps(plan), "utf-8")
    with pytest.raises(DataError, match=r"plan\.json has changed since the run began"):
        hil.resume(run)


@pytest.mark.thorough
def test_another_robot_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    run = copy_of_stopped(tmp_path, step=30)
    station = json.loads((run / "station.yaml").read_text("utf-8").partition("\n")[2])
    station["robots"]["ur5"]["options"] = {"seed": 5}
    (run / "station.yaml").write_text(json.dumps(station), "utf-8")
    files = sorted(run.rglob("*"))
    with pytest.raises(PreflightFailed, match="serial"):
        hil.resume(run)
    assert sorted(run.rglob("*")) == files


@pytest.mark.thorough
def test_a_run_that_ended_before_its_plan_says_so(tmp_path: Path) -> None:
    run = copy_of_stopped(tmp_path, step=30)
    (run / "plan.json").unlink()
    with pytest.raises(DataError, match=r"no plan\.json"):
        hil.resume(run)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [0, 200])
def test_a_kill_before_the_first_sample_costs_nothing_but_that_attempt(
    tmp_path: Path, size: int
) -> None:
    run = copy_of_stopped(tmp_path, step=8)
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


@pytest.mark.thorough
def test_no_other_load_is_declared_before_the_one_in_force_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = len(plan_of_spec(tmp_path, LOADS)) - 1
    run = copy_of_stopped(tmp_path, step=last, text=LOADS)
    told = Told(monkeypatch)
    hil.resume(run)
    assert told.said == ["Mount 2 kg", "2 kg"]


@pytest.mark.thorough
def test_going_back_to_an_earlier_load_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of_spec(tmp_path, LOADS)
    run = copy_of_stopped(tmp_path, step=len(plan) - 1, text=LOADS)
    dwell = next(step.index for step in plan if step.kind == "dwell")
    monkeypatch.setattr(completeness, "step_is_complete", lambda step, *_: step.index > dwell)
    told = Told(monkeypatch)
    hil.resume(run)
    assert told.said[0].startswith("Remove the load again")
    assert told.said[1:] == ["0 kg", "Mount 2 kg", "2 kg"]


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
def test_another_mounting_is_refused(tmp_path: Path) -> None:
    run = copy_of_stopped(tmp_path, step=30)
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
    until(lambda: list(tmp_path.glob("runs/*/*/*/recording/*.partial")), 100)
    time.sleep(0.7)
    running.send_signal(signal.SIGKILL)
    running.communicate(timeout=100)
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


# What is left of a plan, whatever was done of it


def line(a: float, b: float) -> Line:
    return Line((a,) * 6, (b,) * 6, velocity=1.0, acceleration=1.4, jerk=14.0, rate_hz=125.0)


def sweep(poses: int, loads: int, *, weigh: bool = True) -> Plan:
    """Warm-up, then every pose once per load, from home and back, each load weighed first."""
    steps: list[Step] = []
    here = 0.0

    def add(kind: str, motion: object = None, **more: object) -> None:
        steps.append(Step(len(steps), kind, motion, load=load, **more))  # type: ignore[arg-type]

    def go(to: float, kind: str = "move", **more: object) -> None:
        nonlocal here
        add(kind, line(here, to), **more)
        here = to

    for load in range(loads):
        if load and here:
            load -= 1
            go(0.0)
            load += 1
        add("payload", checkpoint=True)
        if weigh:
            go(0.9, checkpoint=True)
            add("weigh", Hold((here,) * 6))
        if load == 0:
            go(0.5, "warmup", checkpoint=True)
            go(-0.5, "warmup")
        for pose in range(poses):
            go(0.1 + 0.1 * pose, checkpoint=True)
            add("dwell", Hold((here,) * 6), pose=pose, approach=1)
            go(0.4 + 0.1 * pose)
            add("dwell", Hold((here,) * 6), pose=pose, approach=-1)
    names = tuple(f"j{i + 1}" for i in range(6))
    bodies = tuple(LoadStep(Payload(float(i))) for i in range(loads))
    return Plan("sweep", "ur5", names, 125.0, tuple(steps), bodies)


def straight(here: FloatArray, target: FloatArray) -> Sequence[Line]:
    return [line(float(here[0]), float(target[0]))]


plans = st.builds(sweep, st.integers(1, 4), st.integers(1, 3), weigh=st.booleans())


@st.composite
def plans_partly_done(draw: st.DrawFn) -> tuple[Plan, set[int]]:
    plan = draw(plans)
    measuring = [step.index for step in plan if step.measures]
    return plan, draw(st.sets(st.sampled_from(measuring)))


@given(plans)
def test_legs_are_all_the_steps_in_order(plan: Plan) -> None:
    assert [step for leg in legs_of(plan) for step in leg.steps] == list(plan)


@pytest.mark.thorough
@given(plans_partly_done(), st.booleans())
@settings(max_examples=200)
def test_exactly_what_is_missing_is_measured_in_the_order_of_the_plan(
    case: tuple[Plan, set[int]], cold: bool
) -> None:
    plan, done = case
    left = [step.index for step in remaining_steps(plan, done, cold=cold) if step.measures]
    missing = [step.index for step in plan if step.measures and step.index not in done]
    assert left == missing


@pytest.mark.thorough
@given(plans_partly_done(), st.booleans(), st.floats(-1.0, 1.0))
@settings(max_examples=200)
def test_every_motion_begins_where_the_last_one_ended(
    case: tuple[Plan, set[int]], cold: bool, here: float
) -> None:
    plan, done = case
    at = np.full(6, here)
    left = remaining_steps(plan, done, cold=cold)
    for step in connected_steps(left, at, straight):
        if step.motion is not None:
            assert np.allclose(step.motion.q_start, at, atol=1e-9)
            at = step.motion.q_end


@pytest.mark.thorough
@given(plans_partly_done())
def test_every_measurement_is_under_its_own_load_weighed_after_it_was_declared(
    case: tuple[Plan, set[int]],
) -> None:
    plan, done = case
    weighs = any(step.kind == "weigh" for step in plan)
    declared = weighed = -1
    for step in remaining_steps(plan, done, cold=False):
        if step.kind == "payload":
            declared = step.load
        if step.kind == "weigh":
            assert declared == step.load
            weighed = step.load
        if step.measures:
            assert declared == step.load
            assert weighed == step.load or not weighs


@given(plans_partly_done())
def test_a_dwell_is_reached_by_the_motion_the_plan_has_for_it(case: tuple[Plan, set[int]]) -> None:
    plan, done = case
    left = connected_steps(remaining_steps(plan, done, cold=False), np.zeros(6), straight)
    for before, step in itertools.pairwise(left):
        if step.kind == "dwell":
            assert before == plan.steps[step.index - 1]


@given(plans)
def test_a_cold_arm_is_warmed_up_once_before_it_measures(plan: Plan) -> None:
    first = next(step.index for step in plan if step.measures)
    left = remaining_steps(plan, {first}, cold=True)
    kinds = [step.kind for step in left]
    if any(step.measures for step in left):
        assert kinds.count("warmup") == 2
        assert kinds.index("warmup") < kinds.index("dwell")


def test_nothing_is_left_of_what_is_all_done() -> None:
    plan = sweep(3, 2)
    done = {step.index for step in plan if step.measures}
    assert remaining_steps(plan, done, cold=True) == []


@given(plans_partly_done(), st.booleans())
def test_the_first_load_is_weighed_again_when_nothing_is_known_of_it(
    case: tuple[Plan, set[int]], cold: bool
) -> None:
    plan, done = case
    left = remaining_steps(plan, done, cold=cold, weigh_first=True)
    same = remaining_steps(plan, done, cold=cold)
    if not same or same[0].load == 0:
        assert left == same
        return
    extra = left[: len(left) - len(same)]
    assert left[len(extra) :] == same
    assert {step.load for step in extra} == {0}
    kinds = ["payload", "move", "weigh"] if any(step.kind == "weigh" for step in plan) else []
    assert [step.kind for step in extra] == (kinds or ["payload"])


def test_the_first_load_is_confirmed_where_the_arm_stands_and_later_ones_at_home() -> None:
    plan = sweep(2, 2, weigh=False)
    dwells = [step.index for step in plan if step.kind == "dwell" and step.load == 0]
    left = connected_steps(
        remaining_steps(plan, set(dwells[:-1]), cold=False), np.full(6, 0.7), straight
    )
    assert left[0].kind == "payload"
    second = next(i for i, s in enumerate(left) if s.kind == "payload" and s.load == 1)
    assert left[second - 1].motion is not None
    assert left[second - 1].motion.q_end[0] == 0.0


# Parts that a kill met before their first sample stop nobody: loading, resuming, reporting


def with_empty_parts(run: RunDirectory, *parts: tuple[int, int], rate_hz: float = 125.0) -> None:
    """What kills leave at a seam, and in the first 0.1 s of an attempt."""
    topic = state_topic(6, rate_hz, clock="virtual", effort_unit="A")
    for part in parts:
        McapWriter(run.part_path(*part), [topic]).abandon()


@pytest.mark.thorough
@pytest.mark.parametrize("recovered", [False, True])
def test_rows_beside_an_empty_part_are_loaded_and_reported(tmp_path: Path, recovered: bool) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4), outcome=None, finish=False)
    before = load_source(run.path)
    with_empty_parts(run, (0, 1), (1, 0))
    if recovered:
        assert {file.did for file in recover(run.path).files} == {"rebuilt", "empty"}
        assert [len(read_topic(path)) == 0 for path in run.recordings] == [False, True, True]
    after = load_source(run.path)
    assert len(before.conditions) > 8
    assert after.conditions == before.conditions
    assert after["q"].tobytes() == before["q"].tobytes()
    told = CliRunner().invoke(app, ["report", str(run.path)])
    assert told.exit_code == 0, told.output
    assert (run.path / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize("recovered", [False, True])
def test_run_of_nothing_but_an_empty_part_says_so_and_is_reported(
    tmp_path: Path, recovered: bool
) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4), outcome=None, finish=False)
    for path in run.recordings:
        path.unlink()
    with_empty_parts(run, (0, 0))
    if recovered:
        assert recover(run.path).error is None
    with pytest.raises(DataError, match=str(run.path)):
        load_source(run.path)
    told = CliRunner().invoke(app, ["report", str(run.path)])
    assert told.exit_code == 0, told.output


@pytest.mark.thorough
@pytest.mark.parametrize("recovered", [False, True])
def test_run_with_empty_parts_is_resumed_to_its_end(tmp_path: Path, recovered: bool) -> None:
    path = copy_of_stopped(tmp_path, step=12)
    run = RunDirectory.open(path)
    with_empty_parts(run, (0, 1), (1, 0))
    if recovered:
        assert recover(path).error is None
    before = measured(path)
    assert before
    assert hil.resume(path).outcome == "completed"
    assert measured(path) == all_steps(path)
    assert [path.name for path in run.recordings][-1] == "02.mcap"


# A process that died between the motion and the report: `hil resume` always ends at a report


STUDIED = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 12, seed: 3}
warm_up: {duration_s: 2}
reference: {every: 0}
accept: {rmse: {max: 5, unit: A, per: joint}}
fit: [{estimator: static-wls}]
study: [{study: counted}]
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that came to its end, with models, a study and a report."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "small.yaml").write_text(STUDIED, "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        report = hil.run(hil.load(folder / "small.yaml"), runs=folder / "runs")
    assert report.error is None
    return report.run


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged as a kill would."""
    return Path(shutil.copytree(whole, tmp_path / "runs" / Path(*whole.parts[-3:])))


@pytest.fixture
def _studies(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


def remove(run: Path, *patterns: str) -> None:
    """Remove what the process had not written yet."""
    for pattern in patterns:
        found = list(run.glob(pattern))
        assert found, pattern
        for path in found:
            path.unlink()


def before_stop(run: Path) -> None:
    remove(run, "stop.json", "verdict.json", "report.html", "fit/*/*", "study/*/*")
    (recording,) = RunDirectory(run).recordings
    recording.rename(f"{recording}.partial")
    reserve(run)


LEFT: dict[str, Callable[[Path], None]] = {
    "before the stop document": before_stop,
    "before the fit": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/*", "study/*/*"
    ),
    "between the files of a model": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/*.safetensors", "fit/*/evaluation.json"
    ),
    "between a model and its evaluation": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/evaluation.json", "study/*/*"
    ),
    "before the verdict": lambda run: remove(run, "verdict.json", "report.html", "study/*/*"),
    "before the studies": lambda run: remove(run, "report.html", "study/*/*"),
    "before the report": lambda run: remove(run, "report.html"),
}


@pytest.mark.usefixtures("_studies")
@pytest.mark.thorough
@pytest.mark.parametrize("moment", LEFT)
def test_a_run_that_was_killed_after_its_motion_is_resumed_to_its_report(
    run: Path, moment: str
) -> None:
    recordings = len(RunDirectory(run).recordings)
    models = {path: path.read_bytes() for path in run.glob("fit/*/model.safetensors")}
    verdict = json.loads((run / "verdict.json").read_text())
    LEFT[moment](run)
    (listed,) = list_runs(run.parents[2])
    assert listed["next"] == f"hil resume {run}"

    report = hil.resume(run)

    assert report.error is None
    assert report.outcome == "completed"
    assert report.report == run / "report.html"
    assert "INTERRUPTED" not in report.report.read_text("utf-8")
    assert {path: path.read_bytes() for path in run.glob("fit/*/model.safetensors")} == models
    assert json.loads((run / "verdict.json").read_text())["rows"] == verdict["rows"]
    assert len(list(run.glob("study/*/study.json"))) == 1
    assert RunDirectory(run).status == "completed"
    assert len(RunDirectory(run).recordings) == recordings  # it did not move
    assert not (run / RESERVE).exists()
    (listed,) = list_runs(run.parents[2])
    assert listed["next"] == ""
    with pytest.raises(DataError, match="evaluated and reported"):
        hil.resume(run)


@pytest.mark.usefixtures("_studies")
def test_trainings_that_a_kill_left_after_the_verdict_are_forgotten(run: Path) -> None:
    (run / TRAINING / "lagrangian-0123456789ab").mkdir(parents=True)
    with pytest.raises(DataError, match="evaluated and reported"):
        hil.resume(run)
    assert not (run / TRAINING).exists()


@pytest.mark.usefixtures("_studies")
def test_a_verdict_stays_as_it_is_and_only_what_is_missing_is_made(run: Path) -> None:
    kept = {p: p.stat().st_mtime_ns for p in run.rglob("*.json")}
    remove(run, "report.html")
    hil.resume(run)
    assert {p: p.stat().st_mtime_ns for p in run.rglob("*.json")} == kept


def edited_verdict(run: Path, **values: object) -> None:
    verdict = json.loads((run / "verdict.json").read_text())
    (run / "verdict.json").write_text(json.dumps(verdict | values))


@pytest.mark.usefixtures("_studies")
@pytest.mark.thorough
def test_a_rejected_run_is_rejected_when_only_its_report_is_written(run: Path) -> None:
    edited_verdict(run, passed=False)
    remove(run, "report.html")
    error = CliRunner().invoke(app, ["resume", str(run)]).exception
    assert isinstance(error, Rejected)
    assert (run / "report.html").is_file()


@pytest.mark.usefixtures("_studies")
def test_a_model_that_could_not_be_fitted_is_still_missing_when_the_report_is_written(
    run: Path,
) -> None:
    problem = {"estimator": "static-mlp-lm", "error": "too few dwells", "hint": "record more"}
    edited_verdict(run, problems=[problem])
    remove(run, "report.html")
    report = hil.resume(run)
    assert isinstance(report.error, FitError)
    assert report.error.message == "static-mlp-lm: too few dwells"
    assert report.error.hint == "record more"
    assert report.report is not None


@pytest.mark.usefixtures("_studies")
def test_a_report_from_before_the_verdict_is_not_taken_for_that_of_the_verdict(run: Path) -> None:
    """A stopped run has a report; one that was resumed may die between verdict and report."""
    verdict = json.loads((run / "verdict.json").read_text())
    remove(run, "verdict.json")
    (run / "report.html").write_text("stopped at step 3")
    RunDirectory(run).write_verdict(verdict)
    assert not (run / "report.html").exists()
    assert hil.resume(run).report is not None


@pytest.mark.usefixtures("_studies")
def test_recover_gives_the_reserve_back_that_a_kill_left(run: Path) -> None:
    before_stop(run)
    recover(run)
    assert not (run / RESERVE).exists()


@pytest.mark.usefixtures("_studies")
def test_a_recovery_that_writes_elsewhere_leaves_the_run_untouched(
    run: Path, tmp_path: Path
) -> None:
    before_stop(run)
    recover(run, tmp_path / "elsewhere")
    assert (run / RESERVE).exists()


@pytest.mark.usefixtures("_studies")
def test_runs_names_the_next_command_by_number_where_one_is_left(run: Path) -> None:
    runs = run.parents[2]

    def table() -> list[str]:
        return CliRunner().invoke(app, ["runs", "--runs", str(runs)]).output.splitlines()

    assert "next" not in table()[0]
    remove(run, "report.html")
    header, row = table()
    assert header.split()[-1] == "next"
    assert row.endswith(f"hil resume 1 --runs {runs}")
