"""The command line: JSON documents, exit codes, messages; piped and narrow."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hil.recording.run_directory import RunDirectory
from tests.support.command import hil
from tests.support.recorded import DWELL, model_of
from tests.support.waiting import until


def station_with(folder: Path, options: str) -> Path:
    station = folder / "bench.yaml"
    robot = f"{{driver: mock, model: ur5, options: {options}}}"
    station.write_text(f"hil_station: 1\nrobots:\n  ur5: {robot}\n", "utf-8")
    return station


@pytest.mark.thorough
def test_validate_says_what_the_spec_is() -> None:
    done = hil("validate", DWELL, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["name"] == "ci-dwell-12"


@pytest.mark.thorough
def test_a_bad_spec_exits_2_with_the_place_of_every_problem(tmp_path: Path) -> None:
    spec = tmp_path / "bad.yaml"
    spec.write_text(DWELL.read_text("utf-8").replace("dwell_s:", "dwel_s:"), "utf-8")
    done = hil("validate", spec)
    assert done.returncode == 2
    assert "bad.yaml:13:3" in done.stderr
    assert "dwell_s" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.thorough
def test_errors_are_json_too_when_asked_for(tmp_path: Path) -> None:
    done = hil("validate", tmp_path / "none.yaml", "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["kind"] == "SpecError"


@pytest.mark.thorough
def test_plan_keeps_its_contract(tmp_path: Path) -> None:
    picture = tmp_path / "motion.svg"
    done = hil("plan", DWELL, "--json", "--picture", picture)
    assert done.returncode == 0, done.stderr
    plan = json.loads(done.stdout)
    wanted = {"waypoints", "duration_s", "recording_bytes", "margins", "condition_number", "hash"}
    assert wanted <= plan.keys()
    assert plan["waypoints"] == 12
    assert all(margin >= 0 for margin in plan["margins"].values())
    assert picture.read_text("utf-8").startswith("<svg")


@pytest.mark.thorough
def test_a_plan_that_determines_nothing_is_still_shown(tmp_path: Path) -> None:
    spec = tmp_path / "one.yaml"
    motion, _, _ = DWELL.read_text("utf-8").partition("\nfit:")
    spec.write_text(motion.replace("waypoints: 12", "waypoints: 1"), "utf-8")
    done = hil("plan", spec, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "infinite" in done.stdout
    picture = (tmp_path / "ci-dwell-12.plan.svg").read_text("utf-8")
    assert "condition number infinite" in picture
    shown = json.loads(hil("plan", spec, "--json", cwd=tmp_path).stdout)
    assert shown["condition_number"] is None


@pytest.mark.thorough
@pytest.mark.parametrize("verb", ["validate", "plan", "run"])
def test_driver_options_are_checked_before_anything_connects(tmp_path: Path, verb: str) -> None:
    station = station_with(tmp_path, "{mounted_payload: {mass_kg: heavy}}")
    done = hil(verb, DWELL, "--station", station, cwd=tmp_path)
    assert done.returncode == 2
    assert f"{station}: robots.ur5: mock option mounted_payload.mass_kg is 'heavy'" in done.stderr
    assert "mass_kg ≥ 0" in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.thorough
def test_a_rate_that_is_not_the_robots_is_refused_before_motion(tmp_path: Path) -> None:
    spec = tmp_path / "fast.yaml"
    spec.write_text(DWELL.read_text("utf-8") + "\nrecord: {rate_hz: 500}\n", "utf-8")
    done = hil("plan", spec, cwd=tmp_path)
    assert done.returncode == 2
    assert "500 Hz, but the robot runs at 125 Hz" in done.stderr


@pytest.mark.thorough
def test_plan_for_humans_fits_a_narrow_terminal(tmp_path: Path) -> None:
    done = hil("plan", DWELL, "--picture", "p.svg", cwd=tmp_path, COLUMNS="60")
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.splitlines()[1:])) <= 60


@pytest.mark.thorough
def test_runs_show_and_report_find_the_run(dwell_run: Path, tmp_path: Path) -> None:
    run = dwell_run
    listed = json.loads(hil("runs", "--runs", run.parents[2], "--json").stdout)
    assert [entry["uid"] for entry in listed] == [RunDirectory.open(run).start["uid"]]
    assert "static-wls" in hil("show", run).stdout
    assert json.loads(hil("show", run, "--json").stdout)["stop"]["outcome"] == "completed"
    copy = shutil.copytree(run, tmp_path / "copy")
    assert hil("report", copy).stdout.strip().endswith("report.html")
    model = str(model_of(run))
    assert model in hil("show", run).stdout
    assert json.loads(hil("show", run, "--json").stdout)["models"] == [model]


@pytest.mark.thorough
def test_fit_and_evaluate_keep_their_contract(dwell_run: Path, tmp_path: Path) -> None:
    run = dwell_run
    fitted = hil("fit", run, "--estimator", "static-wls", "-o", tmp_path, "--json")
    assert fitted.returncode == 0, fitted.stderr
    model = json.loads(fitted.stdout)
    assert model["validation"] == []
    spec = tmp_path / "other_poses.yaml"
    spec.write_text(DWELL.read_text("utf-8").replace("seed: 7", "seed: 8"), "utf-8")
    other = json.loads(hil("run", spec, "--runs", tmp_path, "--json").stdout)["run"]
    judged = hil("evaluate", model["model"], other, "--json")
    assert judged.returncode == 0, judged.stderr
    (row,) = json.loads(judged.stdout)["validation"]
    # Both runs begin with the very same warm-up, which is not what is judged.
    at_once = hil("fit", run, "-e", "static-wls", "-o", tmp_path, "--validate", other, "--json")
    assert json.loads(at_once.stdout)["validation"] == [row]
    assert {"source", "unit", "rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered"} <= set(row)
    assert len(row["rmse_raw"]) == 6


@pytest.mark.thorough
def test_validating_on_the_training_data_is_refused(dwell_run: Path) -> None:
    run = dwell_run
    done = hil("fit", run, "-e", "static-wls", "--validate", run, "--json")
    assert done.returncode == 8
    assert "both training and test" in json.loads(done.stdout)["error"]["message"]


@pytest.mark.thorough
def test_evaluating_on_the_training_data_is_refused(dwell_run: Path, tmp_path: Path) -> None:
    run = dwell_run
    model = json.loads(hil("fit", run, "-e", "static-wls", "-o", tmp_path, "--json").stdout)
    done = hil("evaluate", model["model"], run, "--json")
    assert done.returncode == 8
    error = json.loads(done.stdout)["error"]
    assert "among those the model was fitted to" in error["message"]
    assert "has not seen" in error["hint"]


@pytest.mark.thorough
def test_unknown_estimators_are_guessed() -> None:
    done = hil("fit", "nowhere", "-e", "static-wsl")
    assert done.returncode in (2, 8)
    assert "Traceback" not in done.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("numbers", [[signal.SIGINT, signal.SIGINT], [signal.SIGTERM]])
def test_signals_stop_the_run_and_keep_its_data(tmp_path: Path, numbers: list[int]) -> None:
    spec = tmp_path / "long.yaml"
    text = DWELL.read_text("utf-8").replace("duration_s: 5", "duration_s: 3000")
    spec.write_text(text, "utf-8")
    with subprocess.Popen(
        [sys.executable, "-m", "hil", "run", str(spec), "--runs", str(tmp_path), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        until(lambda: _running(tmp_path) or running.poll() is not None, 100)
        for number in numbers:
            running.send_signal(number)
            time.sleep(0.3)  # two of a kind at once arrive as one
        try:
            out, err = running.communicate(timeout=60)
        finally:
            running.kill()
    assert running.returncode == 130, err
    document = json.loads(out)
    assert document["outcome"] == "stopped"
    assert document["samples"] > 0
    assert (Path(document["run"]) / "stop.json").is_file()
    assert "Traceback" not in err


@pytest.mark.thorough
def test_an_interrupted_plan_prints_one_document(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, "plan", str(DWELL), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    ) as planning:
        out, err = planning.communicate(timeout=60)
    assert planning.returncode == 130, err
    assert json.loads(out)["error"] == {
        "kind": "Stopped", "message": "interrupted", "hint": "", "exit_code": 130,
    }  # fmt: skip
    assert err == "Stopped: interrupted\n"


INTERRUPTED = """
import os, signal
import hil.planning.experiment as experiment
from hil.cli import main

experiment.resolve_robot = lambda *_: os.kill(os.getpid(), signal.SIGINT)
main()
"""


def _running(runs: Path) -> bool:
    logs = list(runs.glob("*/*/*/events.jsonl"))
    return any('"running"' in log.read_text("utf-8") for log in logs)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "code"),
    [("schema", 0), ("runs", 0), ("--help", 0), ("validate nowhere.yaml --json", 2)],
)
def test_a_reader_that_leaves_changes_nothing(arguments: str, code: int) -> None:
    # Only the exit code of hil itself: `true` has closed the pipe before hil writes.
    command = f'{sys.executable} -m hil {arguments} | true; exit "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
@pytest.mark.parametrize("arguments", ["schema", "runs", "runs --json"])
def test_output_that_cannot_be_written_exits_7(arguments: str) -> None:
    command = f"{sys.executable} -m hil {arguments} > /dev/full"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == 7
    assert "RecordingError: standard output: No space left on device" in done.stderr
    assert "next: make room" in done.stderr
    assert "Traceback" not in done.stderr


def test_mistakes_of_the_command_line_are_json_too() -> None:
    done = hil("runs", "--jsn", "--json")
    assert done.returncode == 2
    assert "--jsn" in json.loads(done.stdout)["error"]["message"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "arguments",
    [
        ("plan", DWELL, "--picture", "missing/p.svg"),
        ("plan", DWELL, "-o", "missing/plan.json"),
        ("mock", "embedded", "--truth", "missing/truth.json"),
        ("mock", "embedded", "--truth", "."),
    ],
)
def test_what_cannot_be_written_is_one_line_and_exit_7(arguments: Any, tmp_path: Path) -> None:
    done = hil(*arguments, "--json", cwd=tmp_path)
    assert done.returncode == 7
    error = json.loads(done.stdout)["error"]
    assert error["kind"] == "RecordingError"
    assert str(arguments[-1]) in error["message"]
    assert error["hint"]
    assert "Traceback" not in done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.suffix in (".partial", ".draft")]


@pytest.mark.thorough
def test_a_model_or_report_that_cannot_be_written_exits_7(dwell_run: Path, tmp_path: Path) -> None:
    run = dwell_run
    occupied = tmp_path / "file"
    occupied.touch()
    fitted = hil("fit", run, "-e", "static-wls", "-o", occupied / "models", "--json")
    assert fitted.returncode == 7
    assert str(occupied) in json.loads(fitted.stdout)["error"]["message"]
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "report.html").unlink()
    (copy / "report.html").mkdir()
    report = hil("report", copy)
    assert report.returncode == 7
    assert "report.html" in report.stderr
    assert "Traceback" not in fitted.stderr + report.stderr


def test_a_file_is_no_folder_of_runs_but_a_missing_folder_holds_none(tmp_path: Path) -> None:
    refused = hil("runs", "--runs", DWELL)
    assert refused.returncode == 8
    assert "next: give the folder" in refused.stderr
    empty = hil("runs", "--runs", tmp_path / "later")
    assert empty.returncode == 0
    assert "hil run SPEC" in empty.stdout


@pytest.mark.thorough
def test_show_verify_tells_changed_and_missing_files(dwell_run: Path, tmp_path: Path) -> None:
    whole = hil("show", dwell_run, "--verify")
    assert whole.returncode == 0, whole.stderr
    assert "every file is as the run left it" in whole.stdout
    copy = shutil.copytree(dwell_run, tmp_path / "copy")
    (copy / "plan.json").write_text("{}")
    (copy / "station.yaml").unlink()
    assert hil("show", copy).returncode == 0
    told = hil("show", copy, "--verify", "--json")
    assert told.returncode == 8
    assert sorted(json.loads(told.stdout)["problems"]) == [
        "plan.json has changed since the run ended",
        "station.yaml is missing",
    ]


def test_the_mock_writes_its_truth(tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    done = hil("mock", "embedded", "--truth", truth, "--seed", "3")
    assert done.returncode == 0, done.stderr
    assert "friction" in truth.read_text("utf-8")


@pytest.mark.thorough
def test_doctor_asks_the_robots_of_a_station() -> None:
    done = hil("doctor", "--station", "experiments/stations/mock.yaml")
    assert done.returncode == 0, done.stdout
    assert "the file is valid" in done.stdout
    assert "within hil, nothing to reach" in done.stdout


@pytest.mark.thorough
def test_doctor_and_plugins_answer() -> None:
    assert "python" in hil("doctor").stdout
    listed = json.loads(hil("plugins", "--json").stdout)
    assert {"mock", "rigid-wls", "static-wls"} <= {entry["name"] for entry in listed}
    assert not [entry for entry in listed if entry["error"]]


def test_help_lists_the_exit_codes() -> None:
    assert "Exit codes" in hil("--help").stdout


def test_help_fits_a_narrow_terminal_and_is_plain_in_a_pipe() -> None:
    shown = hil("run", "--help", COLUMNS="60").stdout
    assert "--waive" in shown
    assert max(map(len, shown.splitlines())) <= 60
    assert "\x1b" not in shown


def test_every_mock_arm_is_built_in() -> None:
    assert "any built-in arm" in hil("mock").stdout


@pytest.mark.thorough
def test_a_waiver_needs_a_reason_and_is_recorded(tmp_path: Path) -> None:
    refused = hil("run", DWELL, "--runs", tmp_path, "--waive", "disk")
    assert refused.returncode == 2
    done = hil("run", DWELL, "--runs", tmp_path, "--waive", "disk=a test", "--json")
    assert done.returncode == 0, done.stderr
    start = json.loads((Path(json.loads(done.stdout)["run"]) / "start.json").read_text("utf-8"))
    assert [(w["check"], w["reason"]) for w in start["waivers"]] == [("disk", "a test")]


@pytest.mark.thorough
def test_recordings_are_found_by_the_number_of_their_run(dwell_run: Path, tmp_path: Path) -> None:
    runs = Path(shutil.copytree(dwell_run.parents[2], tmp_path / "runs"))
    where = ("--runs", runs)
    again = hil("report", "1", *where, "--json")
    assert json.loads(again.stdout)["run"] == str(
        runs / dwell_run.relative_to(dwell_run.parents[2])
    )
    fitted = hil("fit", "1", "-e", "static-wls", "-o", tmp_path / "models", *where, "--json")
    assert fitted.returncode == 0, fitted.stderr
    assert hil("fit", "7", "-e", "static-wls", *where).returncode == 8


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("waiver", "told"), [("disk", "gives no reason"), ("nope=because", "names no check")]
)
def test_a_waiver_that_cannot_be_leaves_no_run(tmp_path: Path, waiver: str, told: str) -> None:
    done = hil("run", DWELL, "--runs", tmp_path / "runs", "--waive", waiver)
    assert done.returncode == 2
    assert told in done.stderr
    assert not (tmp_path / "runs").exists()
