"""However a run ends, its directory says how, and nothing is claimed that is not so."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import hil
from hil.core.errors import PreflightFailed, RecordingError, SpecError, Stopped
from hil.engine import Engine
from hil.engine.signals import SignalWatch
from hil.planning.plan import Step
from hil.recording.recorder import Recorder
from hil.recording.run_directory import RESERVE, RESERVE_BYTES, RunDirectory
from hil.workflow import operator, recording
from tests.support.paths import EXPERIMENTS
from tests.support.resuming import small_spec

DWELL = EXPERIMENTS / "ci_dwell_12.yaml"

pytestmark = pytest.mark.usefixtures("plans_once")


@pytest.fixture
def small(tmp_path: Path) -> hil.Experiment:
    """An experiment of four poses."""
    return hil.load(small_spec(tmp_path))


@pytest.mark.thorough
def test_a_recording_that_cannot_be_finished_is_a_failed_run(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = Recorder.close

    def full(self: Recorder, timeout_s: float = 60.0) -> Any:
        close(self, timeout_s)
        raise RecordingError("no space left on device")

    monkeypatch.setattr(Recorder, "close", full)
    report = hil.run(small, runs=tmp_path / "runs")
    assert report.outcome == "failed"
    assert report.verdict == "not judged"
    assert isinstance(report.error, RecordingError)
    assert RunDirectory.open(report.run).status == "failed"
    assert not (report.run / "fit").exists()


@pytest.mark.thorough
def test_a_failed_preflight_moves_nothing_and_is_kept(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: Any, **options: Any) -> None:
        raise PreflightFailed("temperature: too cold")

    monkeypatch.setattr(recording, "require_preflight", refuse)
    report = hil.run(small, runs=tmp_path / "runs")
    assert report.outcome == "failed"
    assert isinstance(report.error, PreflightFailed)
    stop = RunDirectory.open(report.run).stop
    assert stop is not None
    assert stop["steps_done"] == 0


def test_preflight_is_run_and_kept(dwell_run: Path) -> None:
    checks = json.loads((dwell_run / "preflight.json").read_text("utf-8"))["checks"]
    assert {"limits", "pose", "payload"} <= {check["name"] for check in checks}


@pytest.mark.thorough
def test_what_an_observer_broke_is_in_the_stop_document(
    tmp_path: Path, small: hil.Experiment
) -> None:
    class Raises:
        def notify(self, event: Any) -> None:
            raise RuntimeError("plot window closed")

    report = hil.run(small, runs=tmp_path / "runs", observers=[Raises()])
    stop = RunDirectory.open(report.run).stop
    assert stop is not None
    assert any("plot window closed" in problem for problem in stop["problems"])


@pytest.mark.thorough
def test_a_second_signal_during_the_stop_changes_nothing(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    halt = Engine._halt

    def interrupted(self: Engine, error: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        return halt(self, error)

    monkeypatch.setattr(Engine, "_halt", interrupted)
    execute = Engine._execute_plan

    def signalled(self: Engine, preflight: Callable[[], object]) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        execute(self, preflight)

    monkeypatch.setattr(Engine, "_execute_plan", signalled)
    report = hil.run(small, runs=tmp_path / "runs")
    assert report.outcome == "stopped"
    assert RunDirectory.open(report.run).status == "stopped"
    assert not list(report.run.glob("recording/*.partial"))


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_planning_ends_the_command_and_says_so(
    tmp_path: Path, number: signal.Signals
) -> None:
    command = [sys.executable, "-m", "hil", "run", str(EXPERIMENTS / "ur5_dwell_650.yaml")]
    with subprocess.Popen(
        [*command, "--runs", str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "HIL_STATION": ""},
    ) as running:
        assert running.stderr is not None
        while "planning" not in running.stderr.readline():
            pass
        time.sleep(0.3)
        running.send_signal(number)
        _, err = running.communicate(timeout=100)
    assert running.returncode == 130
    assert number.name in err
    assert "Traceback" not in err


def test_nobody_confirms_where_there_is_no_console(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    assert operator.ConsoleOperator()("Mount 3 kg", lambda: None) == (False, "")


def test_while_the_operator_thinks_the_robot_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    read_end, write_end = os.pipe()
    reads: list[int] = []

    class Console:
        def isatty(self) -> bool:
            return True

        def fileno(self) -> int:
            return read_end

        def readline(self) -> str:
            return os.read(read_end, 100).decode()

    def meanwhile() -> None:
        reads.append(1)
        if len(reads) == 3:
            os.write(write_end, b"yes\n")

    monkeypatch.setattr(sys, "stdin", Console())
    assert operator.ConsoleOperator()("Mount 3 kg", meanwhile) == (True, "operator")
    assert len(reads) == 3


def test_a_criterion_in_the_wrong_unit_is_refused_before_anything_moves(tmp_path: Path) -> None:
    spec = tmp_path / "unit.yaml"
    text = DWELL.read_text("utf-8")
    spec.write_text(text[: text.index("accept:")] + "accept: {rmse: {max: 1, unit: Nm}}\n", "utf-8")
    with pytest.raises(SpecError, match="measures a current"):
        hil.run(hil.load(spec), runs=tmp_path)
    assert not list(tmp_path.glob("*/*/*"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("module", "step"), [(recording, "write_beginning"), (recording, "open_recorder")]
)
def test_a_signal_before_the_motion_still_leaves_a_whole_directory(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch, module: Any, step: str
) -> None:
    original = getattr(module, step)

    def interrupted(*arguments: Any, **options: Any) -> Any:
        done = original(*arguments, **options)
        os.kill(os.getpid(), signal.SIGTERM)
        return done

    monkeypatch.setattr(module, step, interrupted)
    report = hil.run(small, runs=tmp_path / "runs")
    assert report.outcome == "stopped"
    assert not list(report.run.glob("recording/*.partial"))


@pytest.mark.thorough
def test_a_disk_that_fills_up_before_the_motion_leaves_a_failed_run(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any, **options: Any) -> Any:
        raise RecordingError("no space left on device")

    monkeypatch.setattr(recording, "open_recorder", full)
    with pytest.raises(RecordingError):
        hil.run(small, runs=tmp_path / "runs")
    (run,) = tmp_path.glob("runs/*/*/*")
    assert RunDirectory.open(run).status == "failed"


@pytest.mark.thorough
def test_a_robot_that_cannot_be_closed_takes_no_finished_run_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hil_mock_robot.embedded.robot import MockRobot

    def broken(self: MockRobot) -> None:
        raise OSError("socket gone")

    monkeypatch.setattr(MockRobot, "close", broken)
    report = hil.run(hil.load(DWELL), runs=tmp_path)
    assert (report.outcome, report.verdict) == ("completed", "passed")
    stop = RunDirectory.open(report.run).stop
    assert stop is not None
    assert any("socket gone" in problem for problem in stop["problems"])


def test_a_signal_that_was_ignored_from_the_start_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with SignalWatch():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_a_library_makes_of_an_interruption_is_still_a_stop(
    tmp_path: Path, small: hil.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any, **options: Any) -> Any:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException:
            raise ImportError("initialization failed") from None

    monkeypatch.setattr(recording, "plan_for", interrupted)
    with pytest.raises(Stopped, match="SIGTERM"):
        hil.run(small, runs=tmp_path / "runs")


# A disk that is really full: the run still says how it ended


SPEC = """
hil: 1
name: full
robot: ur5
excitation: {kind: dwell, waypoints: 4, seed: 3}
warm_up: {duration_s: 60}
reference: {every: 0}
interlocks: [{kind: disk, enabled: false}]
"""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("this user may not mount a small file system")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=False)


@pytest.mark.thorough
def test_a_disk_that_fills_up_in_motion_ends_as_failed_and_keeps_what_there_was(
    tmp_path: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = tmp_path / "full.yaml"
    spec.write_text(SPEC, "utf-8")
    execute = Engine._execute

    def filling(engine: Engine, step: Step) -> None:
        if step.kind == "warmup" and not (small_disk / "other").exists():
            with (
                contextlib.suppress(OSError),
                (small_disk / "other").open("wb", buffering=0) as other,
            ):
                while True:
                    other.write(bytes(4096))
        execute(engine, step)

    monkeypatch.setattr(Engine, "_execute", filling)
    report = hil.run(hil.load(spec), runs=small_disk)
    run = RunDirectory.open(report.run)
    assert report.outcome == "failed"
    assert run.status == "failed"
    assert run.recordings
    assert not (report.run / RESERVE).exists()


@pytest.mark.thorough
def test_a_disk_without_room_for_the_reserve_fails_preflight_before_there_is_a_run(
    tmp_path: Path, small_disk: Path
) -> None:
    spec = tmp_path / "full.yaml"
    spec.write_text(SPEC, "utf-8")
    free = shutil.disk_usage(small_disk).free
    (small_disk / "other").write_bytes(bytes(free - RESERVE_BYTES // 2))
    runs = small_disk / "runs"
    with pytest.raises(PreflightFailed, match=r"disk: 0\.5 MB are free"):
        hil.run(hil.load(spec), runs=runs)
    assert not runs.exists()


def test_a_run_holds_a_reserve_until_its_end(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "reserve")
    assert (run.path / RESERVE).stat().st_size > 0
    run.write_start({"uid": "1"})
    run.write_stop("completed", "")
    assert not (run.path / RESERVE).exists()
    assert run.stop is not None
    assert RESERVE not in run.stop["sha256"]
