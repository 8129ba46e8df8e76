"""The command line: JSON documents, exit codes, messages; piped and narrow."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
DWELL = EXPERIMENTS / "ci_dwell_12.yaml"


def hil(*arguments: Any, cwd: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hil", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "HIL_STATION": "", **env},
        timeout=100,
    )


@pytest.fixture(scope="module")
def done_run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    runs = tmp_path_factory.mktemp("runs")
    done = hil("run", DWELL, "--runs", runs, "--json")
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def test_validate_says_what_the_spec_is() -> None:
    done = hil("validate", DWELL, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["name"] == "ci-dwell-12"


def test_a_bad_spec_exits_2_with_the_place_of_every_problem(tmp_path: Path) -> None:
    spec = tmp_path / "bad.yaml"
    spec.write_text(DWELL.read_text("utf-8").replace("dwell_s:", "dwel_s:"), "utf-8")
    done = hil("validate", spec)
    assert done.returncode == 2
    assert "bad.yaml:13:3" in done.stderr
    assert "dwell_s" in done.stderr
    assert "Traceback" not in done.stderr


def test_errors_are_json_too_when_asked_for(tmp_path: Path) -> None:
    done = hil("validate", tmp_path / "none.yaml", "--json")
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["kind"] == "SpecError"


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


def test_plan_for_humans_fits_a_narrow_terminal(tmp_path: Path) -> None:
    done = hil("plan", DWELL, "--picture", "p.svg", cwd=tmp_path, COLUMNS="60")
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.splitlines()[1:])) <= 60


def test_run_keeps_its_contract(done_run: dict[str, Any]) -> None:
    assert set(done_run) == {
        "run", "uid", "outcome", "verdict", "samples", "gaps", "duplicates", "report",
    }  # fmt: skip
    assert (done_run["outcome"], done_run["verdict"]) == ("completed", "passed")
    assert Path(done_run["report"]).is_file()


def test_runs_show_and_report_find_the_run(done_run: dict[str, Any]) -> None:
    run = Path(done_run["run"])
    listed = json.loads(hil("runs", "--runs", run.parents[2], "--json").stdout)
    assert [entry["uid"] for entry in listed] == [done_run["uid"]]
    assert "static-wls" in hil("show", run).stdout
    assert json.loads(hil("show", run, "--json").stdout)["stop"]["outcome"] == "completed"
    assert hil("report", run).stdout.strip().endswith("report.html")


def test_fit_and_evaluate_keep_their_contract(done_run: dict[str, Any], tmp_path: Path) -> None:
    run = done_run["run"]
    fitted = hil("fit", run, "--estimator", "static-wls", "-o", tmp_path, "--json")
    assert fitted.returncode == 0, fitted.stderr
    model = json.loads(fitted.stdout)
    assert model["validation"] == []
    judged = hil("evaluate", model["model"], run, "--json")
    assert judged.returncode == 0, judged.stderr
    (row,) = json.loads(judged.stdout)["validation"]
    assert {"source", "unit", "rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered"} <= set(row)
    assert len(row["rmse_raw"]) == 6


def test_validating_on_the_training_data_is_refused(done_run: dict[str, Any]) -> None:
    run = done_run["run"]
    done = hil("fit", run, "-e", "static-wls", "--validate", run, "--json")
    assert done.returncode == 8
    assert "both training and test" in json.loads(done.stdout)["error"]["message"]


def test_unknown_estimators_are_guessed() -> None:
    done = hil("fit", "nowhere", "-e", "static-wsl")
    assert done.returncode in (2, 8)
    assert "Traceback" not in done.stderr


def test_a_rejected_model_exits_10(tmp_path: Path) -> None:
    spec = tmp_path / "strict.yaml"
    text = DWELL.read_text("utf-8").replace("accept:", "accept:\n  nrmse: {max: 0.001}")
    spec.write_text(text, "utf-8")
    done = hil("run", spec, "--runs", tmp_path)
    assert done.returncode == 10
    assert "hil show" in done.stderr.splitlines()[-1]


def test_a_tripped_run_exits_5_and_prints_one_document(tmp_path: Path) -> None:
    lock = "interlocks: [{kind: tracking_error, limit_rad: 0.0005}]"
    spec = tmp_path / "tight.yaml"
    spec.write_text(DWELL.read_text("utf-8") + f"\n{lock}\n", "utf-8")
    done = hil("run", spec, "--runs", tmp_path, "--json")
    assert done.returncode == 5
    assert json.loads(done.stdout)["outcome"] == "tripped"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_run_and_keeps_its_data(tmp_path: Path, number: int) -> None:
    spec = tmp_path / "long.yaml"
    text = DWELL.read_text("utf-8").replace("duration_s: 5", "duration_s: 3000")
    spec.write_text(text, "utf-8")
    with subprocess.Popen(
        [sys.executable, "-m", "hil", "run", str(spec), "--runs", str(tmp_path), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        deadline = time.monotonic() + 60
        while not _running(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.05)
        running.send_signal(number)
        out, err = running.communicate(timeout=60)
    assert running.returncode == 130, err
    document = json.loads(out)
    assert document["outcome"] == "stopped"
    assert document["samples"] > 0
    assert (Path(document["run"]) / "stop.json").is_file()
    assert "Traceback" not in err


def _running(runs: Path) -> bool:
    logs = list(runs.glob("*/*/*/events.jsonl"))
    return any('"running"' in log.read_text("utf-8") for log in logs)


def test_a_pipe_that_closes_is_no_error() -> None:
    command = f"{sys.executable} -m hil schema | head -n 1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", command], capture_output=True, text=True)
    assert "Traceback" not in done.stderr


def test_the_mock_writes_its_truth(tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    done = hil("mock", "embedded", "--truth", truth, "--seed", "3")
    assert done.returncode == 0, done.stderr
    assert "friction" in truth.read_text("utf-8")


def test_doctor_and_plugins_answer() -> None:
    assert "python" in hil("doctor").stdout
    listed = json.loads(hil("plugins", "--json").stdout)
    assert {"mock", "rigid-wls", "static-wls"} <= {entry["name"] for entry in listed}
    assert not [entry for entry in listed if entry["error"]]


def test_help_lists_the_exit_codes() -> None:
    assert "Exit codes" in hil("--help").stdout


def test_a_waiver_needs_a_reason_and_is_recorded(tmp_path: Path) -> None:
    refused = hil("run", DWELL, "--runs", tmp_path, "--waive", "disk")
    assert refused.returncode == 3
    done = hil("run", DWELL, "--runs", tmp_path, "--waive", "disk=a test", "--json")
    assert done.returncode == 0, done.stderr
    start = json.loads((Path(json.loads(done.stdout)["run"]) / "start.json").read_text("utf-8"))
    assert [(w["check"], w["reason"]) for w in start["waivers"]] == [("disk", "a test")]
