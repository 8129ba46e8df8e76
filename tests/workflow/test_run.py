"""The main job on the embedded mock: spec → plan → run → fit → verdict → report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import hil
from hil import api
from hil.core.errors import DataError
from hil.evaluation.holdout import hold_out
from hil.importers.sources import load_source
from hil.recording.mcap_reader import read_topic
from hil.recording.run_directory import RunDirectory
from hil.spec.experiment import HoldOut
from tests.support.command import hil as command
from tests.support.paths import EXPERIMENTS
from tests.support.recorded import model_of, run_in


def changed_spec(tmp_path: Path, old: str, new: str, name: str = "ci_dwell_12.yaml") -> Path:
    text = (EXPERIMENTS / name).read_text("utf-8")
    assert old in text
    spec = tmp_path / name
    spec.write_text(text.replace(old, new), "utf-8")
    return spec


def test_a_run_is_told_in_one_document(dwell_lab: Path) -> None:
    told = json.loads((dwell_lab / "report.json").read_text("utf-8"))
    assert set(told) == {
        "run", "uid", "outcome", "verdict", "samples", "gaps", "duplicates", "models", "report",
    }  # fmt: skip
    run = run_in(dwell_lab)
    assert (told["run"], told["uid"]) == (str(run), RunDirectory.open(run).start["uid"])
    assert (told["outcome"], told["verdict"]) == ("completed", "passed")
    assert told["gaps"] == told["duplicates"] == 0
    assert told["models"] == [str(model_of(run))]
    assert (model_of(run) / "model.json").is_file()
    assert told["report"] == str(run / "report.html")
    assert told["samples"] == len(read_topic(run / "recording" / "00.mcap"))


def test_a_fourier_experiment_completes_with_a_judged_model(fourier_run: Path) -> None:
    facts = api.describe_run(fourier_run)
    assert facts["stop"]["outcome"] == "completed"
    assert facts["verdict"]["verdict"] == "passed"


def test_the_run_directory_explains_itself(dwell_run: Path) -> None:
    run = RunDirectory.open(dwell_run)
    assert run.status == "completed"
    assert run.verify() == []
    names = {path.name for path in dwell_run.iterdir()}
    assert {
        "start.json", "stop.json", "spec.yaml", "station.yaml", "plan.json", "preflight.json",
        "recording", "events.jsonl", "fit", "verdict.json", "report.html",
    } <= names  # fmt: skip
    assert run.start["plan_hash"]
    assert run.start["robot"]["effort_kind"] == "current"


def test_every_pose_is_dwelt_at_from_both_sides(dwell_run: Path) -> None:
    dwells = load_source(dwell_run).of_kind("dwell")
    visits = {(c.pose, c.approach) for c in dwells.conditions}
    assert visits == {(pose, side) for pose in range(12) for side in (-1, 1)}
    assert set(np.diff(dwells.offsets)) == {10}


def test_the_recording_has_every_sample_at_its_time(dwell_run: Path) -> None:
    rows = read_topic(dwell_run / "recording" / "00.mcap")
    np.testing.assert_allclose(np.diff(rows["device_time"]), 1 / 125, rtol=1e-6)


def test_held_out_poses_are_whole_and_unseen(dwell_run: Path) -> None:
    parts = hold_out(load_source(dwell_run), HoldOut(poses_percent=25))
    train = {c.pose for c in parts.train.conditions}
    test = {c.pose for c in parts.test.conditions}
    assert len(test) == 3
    assert train.isdisjoint(test)


def test_held_out_trajectories_are_the_last_ones(fourier_run: Path) -> None:
    parts = hold_out(load_source(fourier_run), HoldOut(trajectories=1))
    assert {c.trajectory for c in parts.test.conditions} == {2}
    assert {c.trajectory for c in parts.train.conditions} == {0, 1}


def test_holding_out_nothing_is_refused(fourier_run: Path) -> None:
    with pytest.raises(DataError, match="hold_out"):
        hold_out(load_source(fourier_run), HoldOut(trajectories=0))


def test_the_same_seed_gives_byte_identical_samples(dwell_run: Path, tmp_path: Path) -> None:
    again = hil.run(hil.load(EXPERIMENTS / "ci_dwell_12.yaml"), runs=tmp_path)
    first = read_topic(dwell_run / "recording" / "00.mcap")
    second = read_topic(again.run / "recording" / "00.mcap")
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize("as_json", [False, True])
def test_a_model_that_misses_its_criteria_is_rejected(as_json: bool, tmp_path: Path) -> None:
    spec = changed_spec(tmp_path, "accept:", "accept:\n  nrmse: {max: 0.001}")
    said = command("run", spec, "--runs", tmp_path / "runs", *(["--json"] if as_json else []))
    assert said.returncode == 10
    run = run_in(tmp_path)
    assert RunDirectory.open(run).status == "completed"
    verdict = json.loads((run / "verdict.json").read_text("utf-8"))
    assert [row["passed"] for row in verdict["rows"] if row["metric"] == "nrmse"] == [False]
    if as_json:
        assert said.document["verdict"] == "rejected"
        assert "Rejected" in said.stderr
    else:
        assert "hil show" in said.stderr.splitlines()[-1]


@pytest.mark.thorough
def test_the_shipped_experiment_with_loads_is_judged_on_what_is_new_in_both(tmp_path: Path) -> None:
    text = (EXPERIMENTS / "ur5_fourier_loads.yaml").read_text("utf-8")
    for old, new in (
        ("trajectories: 12", "trajectories: 2"),
        ("trajectories: 3,", "trajectories: 1,"),
        ("duration_s: 60", "duration_s: 5"),
    ):
        assert old in text
        text = text.replace(old, new)
    spec = tmp_path / "loads.yaml"
    spec.write_text(text, "utf-8")
    report = hil.run(hil.load(spec), runs=tmp_path)
    assert report.error is None
    assert (report.outcome, report.verdict) == ("completed", "passed")
    document = json.loads(next(report.run.glob("fit/*/evaluation.json")).read_text("utf-8"))
    assert document["held_out"]["what"] == (
        "the last trajectory with 3 kg: motions and payloads that are not in the training data"
    )
    assert len(document["held_out"]["series"]) == 1
    assert [part["what"] for part in document["beside"]] == [
        "new load, seen motion",
        "new motion, seen load",
    ]
    page = (report.run / "report.html").read_text("utf-8")
    assert "new loads and new motions separately" in page


def test_a_run_that_trips_keeps_its_data_and_is_not_judged(tmp_path: Path) -> None:
    lock = "interlocks: [{kind: tracking_error, limit_rad: 0.0005}]"
    spec = changed_spec(tmp_path, "robot: ur5", f"robot: ur5\n{lock}")
    said = command("run", spec, "--runs", tmp_path / "runs", "--json")
    assert said.returncode == 5
    told, run = said.document, run_in(tmp_path)
    assert (told["outcome"], told["verdict"]) == ("tripped", "not judged")
    assert told["samples"] == len(read_topic(run / "recording" / "00.mcap"))
    assert Path(told["report"]).is_file()
    assert "tracking_error" in (RunDirectory.open(run).stop or {})["reason"]


@pytest.mark.thorough
def test_the_mock_mounts_each_load_and_the_model_knows(tmp_path: Path) -> None:
    spec = changed_spec(tmp_path, "robot: ur5", "robot: ur5\nloads: [{mass_kg: 0}, {mass_kg: 2}]")
    spec.write_text(spec.read_text("utf-8").replace("{poses_percent: 20}", "{loads: [1]}"), "utf-8")
    report = hil.run(hil.load(spec), runs=tmp_path)
    document = json.loads(next(report.run.glob("fit/*/evaluation.json")).read_text("utf-8"))
    assert report.error is None
    assert document["held_out"]["what"] == "2 kg, motions of the training data with other payloads"
    assert report.verdict == "passed"
    data = load_source(report.run).of_kind("dwell")
    assert {(c.load, c.payload.mass) for c in data.conditions} == {(0, 0.0), (1, 2.0)}
    lift = {0: [], 1: []}  # type: dict[int, list[float]]
    for condition, rows in data.slices():
        lift[condition.load].append(float(np.abs(data["effort"][rows, 1]).mean()))
    assert np.mean(lift[1]) > np.mean(lift[0]) + 0.5


def test_runs_are_listed_and_described(dwell_run: Path) -> None:
    (listed,) = api.list_runs(dwell_run.parents[2])
    facts = api.describe_run(dwell_run)
    assert (listed["verdict"], listed["uid"]) == ("passed", facts["start"]["uid"])
    assert facts["stop"]["outcome"] == "completed"
