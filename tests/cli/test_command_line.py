"""The command line: JSON documents, exit codes, messages; piped and narrow."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import typer

import hil as package
from hil.cli import app as command_line
from hil.cli.app import _as_ours, app
from hil.core.errors import DataError, RecordingError
from hil.recording.run_directory import RunDirectory
from tests.support.command import Said, hil
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
    assert "are training data of the model" in error["message"]
    assert "did not use" in error["hint"]


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


LATE = """
import os, signal, sys
from hil.cli.app import main
try:
    main()
finally:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_signals_after_the_work_change_no_exit_code() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LATE, "explain", "exit", "8"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


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
    assert "next: free disk space" in done.stderr
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
        ("mock", "embedded", "--ground-truth", "missing/truth.json"),
        ("mock", "embedded", "--ground-truth", "."),
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
    assert "next: name the folder" in refused.stderr
    empty = hil("runs", "--runs", tmp_path / "later")
    assert empty.returncode == 0
    assert "hil run SPEC" in empty.stdout


@pytest.mark.thorough
def test_show_verify_tells_changed_and_missing_files(dwell_run: Path, tmp_path: Path) -> None:
    whole = hil("show", dwell_run, "--verify")
    assert whole.returncode == 0, whole.stderr
    assert "all files are unchanged since the end of the run" in whole.stdout
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
    done = hil("mock", "embedded", "--ground-truth", truth, "--seed", "3")
    assert done.returncode == 0, done.stderr
    assert "friction" in truth.read_text("utf-8")


@pytest.mark.thorough
def test_doctor_asks_the_robots_of_a_station() -> None:
    done = hil("doctor", "--station", "experiments/stations/mock.yaml")
    assert done.returncode == 0, done.stdout
    assert "the file is valid" in done.stdout
    assert "simulated within hil, no connection to check" in done.stdout


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
    ("waiver", "told"), [("disk", "has no reason"), ("nope=because", "is not the name of a check")]
)
def test_a_waiver_that_cannot_be_leaves_no_run(tmp_path: Path, waiver: str, told: str) -> None:
    done = hil("run", DWELL, "--runs", tmp_path / "runs", "--waive", waiver)
    assert done.returncode == 2
    assert told in done.stderr
    assert not (tmp_path / "runs").exists()


# Small things people type first: versions, lists, wrong file names


MAP = """\
hil_map: 1
format: csv
robot: two-link
joint_names: [a, b]
effort_kind: torque
columns:
  t: {rate_hz: 100}
  q: {columns: "1:2", unit: rad}
  effort: {columns: "3:4", unit: N·m}
"""


def importing(folder: Path, out: str) -> Said:
    (folder / "map.yaml").write_text(MAP, "utf-8")
    (folder / "run.csv").write_text("0,0,1,1\n0.1,0.1,1,2\n", "utf-8")
    return hil("import", "run.csv", "--map", "map.yaml", "-o", out, cwd=folder)


def test_version_is_told() -> None:
    assert hil("--version").stdout == f"hil {package.__version__}\n"


def test_benchmarks_are_listed_with_what_they_measure() -> None:
    listed = json.loads(hil("bench", "list", "--json").stdout)
    told = {entry["name"]: entry["description"] for entry in listed}
    assert "faster than real time" in told["mock"]
    assert all(told.values())


def test_a_picture_of_another_format_is_refused_before_planning(tmp_path: Path) -> None:
    done = hil("plan", DWELL, "--picture", "motion.pdf", cwd=tmp_path)
    assert done.returncode == 2
    assert "--picture motion.svg" in done.stderr


@pytest.mark.thorough
def test_an_ordinary_plan_has_no_warnings_and_a_poor_one_says_so(tmp_path: Path) -> None:
    good = json.loads(hil("plan", DWELL, "--json", cwd=tmp_path).stdout)
    assert good["warnings"] == []
    poor = tmp_path / "poor.yaml"
    poor.write_text("hil: 1\nname: poor\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 1}\n")
    done = hil("plan", poor, cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: " in done.stdout
    assert "condition number" in done.stdout.partition("warning: ")[2]


@pytest.mark.thorough
def test_import_never_replaces_a_file_and_says_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_text("mine")
    done = importing(tmp_path, "out.mcap")
    assert done.returncode == 7
    assert "choose a different file for -o" in done.stderr
    assert (tmp_path / "out.mcap").read_text() == "mine"


@pytest.mark.thorough
def test_import_makes_no_folders_unasked(tmp_path: Path) -> None:
    done = importing(tmp_path, "imprted/out.mcap")
    assert done.returncode == 7
    assert "mkdir -p imprted" in done.stderr
    assert not (tmp_path / "imprted").exists()


@pytest.mark.thorough
def test_columns_are_counted_from_one(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP.replace('"1:2"', '"0:1"'), "utf-8")
    (tmp_path / "run.csv").write_text("0,0,1,1\n0.1,0.1,1,2\n", "utf-8")
    done = hil("import", "run.csv", "--map", "map.yaml", "-o", "out.mcap", cwd=tmp_path)
    assert done.returncode == 2
    assert "columns.q.columns: columns are counted from 1" in done.stderr


@pytest.mark.thorough
def test_the_schema_of_import_maps_is_printed() -> None:
    schema = json.loads(hil("schema", "map").stdout)
    assert schema["title"] == "hil map"
    assert "joint_names" in schema["required"]


LACKING = """
import sys, hil, hil_mock_robot
from pathlib import Path
FILE = Path(hil_mock_robot.__file__).with_name("ranges.yaml")
from hil.cli.app import _as_ours
error = FileNotFoundError(2, "No such file or directory", str(FILE))
sys.stdout.write(f"{type(_as_ours(error)).__name__} {_as_ours(error).exit_code} {_as_ours(error)}")
"""


def test_a_file_that_an_installation_lacks_is_no_fault_of_a_recording() -> None:
    done = subprocess.run([sys.executable, "-c", LACKING], capture_output=True, text=True)
    assert done.stdout.startswith("PluginError 2 "), done.stderr
    assert "ranges.yaml" in done.stdout
    assert "install hil again" in done.stdout


def test_a_file_that_may_not_be_read_is_no_place_to_write_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = tmp_path / "start.json"
    closed.touch()
    refused = partial(PermissionError, 13, "Permission denied")
    monkeypatch.setattr(
        os, "access", lambda path, mode, **_: mode != os.R_OK or Path(path) != closed
    )
    told = _as_ours(refused(str(closed)))
    assert (type(told), told.message) == (DataError, f"cannot read {closed}: Permission denied")
    assert told.hint == "check the permissions of the path"
    assert isinstance(_as_ours(refused(str(tmp_path / "other"))), RecordingError)


# Every command keeps the same manners: one JSON document with `--json`, on errors too


WITHOUT_JSON = {
    "schema": "prints nothing but a JSON document",
    "serve": "prints its address and then serves",
    "schedule run": "goes on until it is ended; `schedule show` has what was done",
    "schedule hold": "`schedule show` has it",
    "schedule release": "`schedule show` has it",
}
"""Commands without `--json`, and why."""
STARTS_SOMETHING = {"bench", "mock"}
"""Not called with whatever word: `list` is asked for."""
OPTIONS = {"estimator": "rigid-wls", "map_": "map.yaml", "out": "out", "reason": "because"}
"""What required options are given, else `nothing`."""
OURS = ("Error", "Timeout")
CODES = set(range(12)) - {1}


def verbs() -> Iterator[tuple[str, Any]]:
    def walk(command: Any, words: list[str]) -> Iterator[tuple[str, Any]]:
        for name, one in getattr(command, "commands", {}).items():
            yield from walk(one, [*words, name])
        if not hasattr(command, "commands"):
            yield " ".join(words), command

    yield from walk(typer.main.get_command(app), [])


VERBS = dict(verbs())


def has_json(command: Any) -> bool:
    return any("--json" in getattr(p, "opts", ()) for p in command.params)


def call(
    monkeypatch: pytest.MonkeyPatch, *words: str, columns: int | None = None
) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `hil WORDS`, as the script ends it."""
    out, err = io.StringIO(), io.StringIO()
    if columns is not None:
        monkeypatch.setattr(out, "isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(columns))
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", ["hil", *words])
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        try:
            command_line.main()
            code: Any = 0
        except SystemExit as ending:
            code = ending.code or 0
    return code, out.getvalue(), err.getvalue()


def words_for(verb: str) -> list[str]:
    """The command with a word at every required place, none of which leads anywhere."""
    if verb in STARTS_SOMETHING:
        return [*verb.split(), "list"]
    words = verb.split()
    for parameter in VERBS[verb].params:
        if parameter.required:
            word = OPTIONS.get(parameter.name, "nothing")
            is_argument = parameter.param_type_name == "argument"
            words += [word] if is_argument else [parameter.opts[0], word]
    return words


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, with nothing named by the environment."""
    for name in ("HIL_RUNS", "HIL_REGISTRY", "HIL_STATION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_file_with_verbs_is_listed() -> None:
    folder = Path(command_line.__file__).parent
    files = {
        file.stem for file in folder.glob("*.py") if "\napp = typer.Typer(" in file.read_text()
    }
    assert files - {"app"} == set(command_line.FILES)


def test_commands_without_json_are_known_and_why() -> None:
    assert {verb for verb, one in VERBS.items() if not has_json(one)} == set(WITHOUT_JSON)


@pytest.mark.thorough
@pytest.mark.parametrize("verb", sorted(set(VERBS) - set(WITHOUT_JSON) - {"doctor"}))
def test_one_document_is_printed_when_nothing_is_there(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, err = call(monkeypatch, *words_for(verb), "--json")
    document = json.loads(out)
    assert code in CODES, err
    if code:
        assert set(document["error"]) == {"kind", "message", "hint", "exit_code"}
        assert document["error"]["exit_code"] == code
        if document["error"]["kind"].endswith(OURS):  # typer draws a box around its own
            assert document["error"]["message"].partition("\n")[0] in err
        assert document["error"]["hint"]
    else:
        assert "error" not in document


@pytest.mark.thorough
@pytest.mark.parametrize("verb", sorted(set(VERBS) - set(WITHOUT_JSON)))
def test_a_mistake_in_the_command_line_is_one_document(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if verb == "mock":
        pytest.skip("hands what it does not know to the mock")
    code, out, err = call(monkeypatch, *verb.split(), "--no-such-option", "--json")
    told = json.loads(out)["error"]
    assert code == told["exit_code"] == 2
    assert "--no-such-option" in told["message"]
    assert "--no-such-option" in err


LISTS = ("runs", "models list", "robots", "bench list", "mock list", "plugins")


@pytest.mark.thorough
@pytest.mark.parametrize("verb", LISTS)
@pytest.mark.parametrize("columns", [40, 60])
def test_lists_fit_a_narrow_terminal(
    verb: str, columns: int, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = call(monkeypatch, *verb.split(), columns=columns)
    assert code == 0
    unbroken = [  # a word longer than the terminal, such as a path, stays whole
        line for line in out.splitlines() if len(line) > columns and " " in line.strip()
    ]
    assert unbroken == []


@pytest.mark.thorough
@pytest.mark.parametrize("verb", LISTS)
def test_nothing_is_broken_in_a_pipe(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    code, out, _ = call(monkeypatch, *verb.split())
    assert code == 0
    if verb in ("bench list", "plugins", "mock list"):
        assert max(map(len, out.splitlines())) > 40


@pytest.mark.parametrize("verb", ["runs", "models list"])
def test_where_nothing_is_the_next_command_is_said(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = call(monkeypatch, *verb.split())
    assert code == 0
    assert ": hil " in out


def test_an_argument_that_may_be_left_out_says_what_then() -> None:
    silent = [
        f"{verb} {parameter.name}"
        for verb, command in VERBS.items()
        for parameter in command.params
        if parameter.param_type_name == "argument" and not parameter.required
        if not parameter.help
        or not (
            re.search("by default|[Dd]efault:", parameter.help)
            or (parameter.show_default and parameter.default)
        )
    ]
    assert silent == []
