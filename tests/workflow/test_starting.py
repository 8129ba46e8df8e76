"""Starting runs for somebody without a console: they live on by themselves, and are asked for."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RecordingError, SpecError
from hil.recording.events import read_events
from hil.recording.provenance import STARTED_ID, collect_provenance, started_as
from hil.recording.run_directory import RunDirectory
from hil.workflow import background_runs
from hil.workflow.background_runs import Started, check_start, start_run, started_runs
from hil.workflow.live_state import read_live
from hil.workflow.remote_control import answer_run
from tests.support.started_parts import PROMPT, begun, written
from tests.support.waiting import until

pytestmark = pytest.mark.wire

SLEEP = "import time; time.sleep(60)"
HOLDS = """
import sys, time
from pathlib import Path
from hil.workflow.remote_control import hold_attempt
with hold_attempt(Path(sys.argv[1])):
    time.sleep(60)
"""


def test_a_started_run_waits_for_its_answer_and_is_known_by_its_process(tmp_path: Path) -> None:
    with begun(tmp_path, wall=False) as (started, run):
        assert started_runs(tmp_path / "runs") == [started]
        assert os.getsid(started.pid) == started.pid  # a session of its own
        until(lambda: read_live(run).get("prompt") == PROMPT)
        answer_run(run, True, who="bert")
        until(lambda: not started.alive, 30)
        asked = [e for e in read_events(run / "events.jsonl") if e["kind"] == "prompt"]
        assert [e["answered_by"] for e in asked] == ["bert"]
        assert RunDirectory.open(run).start["operator"] == "anna"
        assert RunDirectory.open(run).status == "completed"
        assert any("not judged" in line or "completed" in line for line in started.last_words)


def test_modules_in_the_working_folder_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that was opened may hold a `hil.py` of its author's."""
    mark = tmp_path / "mark"
    (tmp_path / "hil.py").write_text(f"open({str(mark)!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    with begun(tmp_path, wall=False):
        pass
    assert not mark.exists()


def test_what_is_wrong_is_told_before_anything_is_started(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(spec.read_text().replace("ur5", "ur6").replace("kind: dwell", "kind: dwel"))
    with pytest.raises(SpecError) as caught:
        start_run(wrong, tmp_path / "runs", station=station)
    assert "dwel" in caught.value.message
    assert not (tmp_path / "runs").exists()
    (experiment,) = check_start(spec, station)
    assert experiment.spec.name == "asks-first"


def test_a_schedule_is_not_started_so(tmp_path: Path) -> None:
    schedule = tmp_path / "weekly.yaml"
    schedule.write_text("hil_schedule: 1\nname: weekly\n")
    with pytest.raises(SpecError, match="is a schedule, not an experiment"):
        check_start(schedule, None)


def test_one_that_dies_before_it_has_a_run_directory_leaves_its_last_words(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    wall = "{name: near, point_m: [0, -0.25, 0], normal: [0, 1, 0]}"
    cramped = f"model: ur5, surroundings: {{walls: [{wall}]}}"
    station.write_text(station.read_text().replace("model: ur5", cramped))
    started = start_run(spec, tmp_path / "runs", station=station)
    try:
        until(lambda: not started.alive, 20)
    finally:
        started.cancel()
    assert started.made == []
    assert "upper arm and near" in "\n".join(started.last_words)
    assert len(started.last_words) <= background_runs.LAST_LINES


def test_another_process_with_its_number_is_not_it(tmp_path: Path) -> None:
    mine = Started("x", str(tmp_path), "s", "", "", os.getpid(), 0, 0.0, os.uname().nodename)
    assert not mine.alive
    assert not replace(mine, ticks=1).alive
    replace(mine, ticks=1).cancel()  # would end this test run


@pytest.mark.parametrize("given", ["", "x"])
def test_what_a_record_claims_to_be_its_process_is_not_ended(tmp_path: Path, given: str) -> None:
    environment = os.environ | ({STARTED_ID: given} if given else {})
    with subprocess.Popen([sys.executable, "-c", SLEEP], env=environment) as other:
        ticks = background_runs.ticks_of(other.pid)
        forged = Started("x", str(tmp_path), "s", "", "", other.pid, ticks, 0.0, platform.node())
        assert forged.alive
        with pytest.raises(DataError, match="was not stopped, because"):
            forged.cancel()
        assert forged.alive
        other.kill()


def test_a_run_that_hangs_before_it_listens_is_cancelled_by_a_signal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "hil.workflow.background_runs.is_ours", lambda pid, name: pid == hanging.pid
    )
    directory = RunDirectory.create(tmp_path.resolve(), "ur5", "held")
    directory.write_start({"uid": "u"})
    run = directory.path
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(run)]) as hanging:
        until(lambda: (run / ".control").is_dir())
        ticks, node = background_runs.ticks_of(hanging.pid), platform.node()
        started = Started("x", str(tmp_path), str(run), "", "", hanging.pid, ticks, 0.0, node)
        assert started.made == [run]
        started.cancel("anna")
        assert hanging.wait(10) == -signal.SIGTERM


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_only_a_file_is_a_log(tmp_path: Path, kind: str) -> None:
    log, secret = tmp_path / "1.log", tmp_path / "secret"
    secret.write_text("not for you\n")
    if kind == "link":
        log.symlink_to(secret)
    else:
        os.mkfifo(log)
    assert background_runs.last_lines(log) == []


def test_a_run_is_of_the_process_that_was_started_under_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = Started("17", str(tmp_path), "s", "", "", os.getpid(), 1, 4e9, platform.node())
    # Its number and host are those of another run: so may numbers be given again.
    other, run = (tmp_path / "2026-11-23" / "ur5" / name for name in ("0001-a", "0002-b"))
    for folder in (other, run):
        folder.mkdir(parents=True)
    (other / "start.json").write_text(json.dumps(collect_provenance()))
    assert mine.made == []
    monkeypatch.setenv(STARTED_ID, "17")
    (run / "start.json").write_text(json.dumps(collect_provenance()))
    assert mine.made == [run]  # whatever the clocks say: it was started in the year 2096
    again = replace(mine, spec=str(other))
    assert again.made == []
    (other / "resume-01.json").write_text(json.dumps(started_as()))
    (other / "resume-02.json").write_text(json.dumps({"started_as": "18"}))
    assert again.made == [other]


def test_only_so_many_are_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background_runs, "KEPT", 1)
    spec, _ = written(tmp_path)
    for _ in range(2):
        started = start_run(spec, tmp_path / "runs")
        started.cancel()
        until(lambda started=started: not started.alive, 20)
    third = start_run(spec, tmp_path / "runs")
    third.cancel()
    until(lambda: not third.alive, 20)
    assert [each.id for each in started_runs(tmp_path / "runs")] == [third.id]
    left = sorted(path.name for path in (tmp_path / "runs" / background_runs.FOLDER).iterdir())
    assert left == [f"{third.id}.json", f"{third.id}.log"]


def test_a_live_run_is_cancelled_by_name_as_hil_stop_would(tmp_path: Path) -> None:
    with begun(tmp_path, wall=False) as (started, run):
        until(lambda: read_live(run).get("prompt") == PROMPT)
        started.cancel("bert")
        until(lambda: not started.alive, 20)
        assert RunDirectory.open(run).status == "stopped"
        assert "bert" in (run / "stop.json").read_text()


@pytest.mark.parametrize(
    ("key", "value"),
    [("time", "x"), ("time", 1e999), ("pid", [1]), ("pid", -1), ("ticks", None), ("spec", 3),
     ("host", {}), ("operator", ["a"]), ("station", None), ("time", 10**400), ("spec", "\0")],
    ids=lambda value: repr(value)[:9],
)  # fmt: skip
def test_a_record_of_another_kind_is_none(tmp_path: Path, key: str, value: object) -> None:
    whole = {"id": "", "runs": "", "spec": "s", "station": "", "operator": "", "pid": os.getpid(),
             "ticks": 1, "time": 1.0, "host": os.uname().nodename}  # fmt: skip
    folder = tmp_path / background_runs.FOLDER
    folder.mkdir()
    (folder / "1.json").write_text(json.dumps(whole))
    (folder / "2.json").write_text(json.dumps(whole | {key: value}))
    (folder / "3.json").write_text("[]")
    assert [each.id for each in started_runs(tmp_path)] == ["1"]


def test_a_record_that_cannot_be_written_ends_what_was_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun_ones = []
    really_begin = background_runs.begin

    def begin(command: list[str], log: Path) -> Any:
        begun_ones.append(really_begin([sys.executable, "-c", SLEEP], log))
        return begun_ones[0]

    def full(*arguments: object) -> None:
        raise RecordingError("no space left on device")

    monkeypatch.setattr(background_runs, "begin", begin)
    monkeypatch.setattr(background_runs, "write_replacing", full)
    with pytest.raises(RecordingError):
        start_run(written(tmp_path)[0], tmp_path / "runs")
    until(lambda: not background_runs.ticks_of(begun_ones[0].pid), 10)


def test_what_no_command_can_be_given_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="NUL"):
        start_run(written(tmp_path)[0], tmp_path / "runs", operator="an\0na")
    assert not (tmp_path / "runs").exists()


def test_a_spec_named_as_an_option_is_a_spec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HIL_TOKEN", "secret of the dashboard")
    written(tmp_path)[0].rename("--runs=x.yaml")
    given: list[list[str]] = []
    really_begin = background_runs.begin

    def begin(command: list[str], log: Path) -> Any:
        given.append(command)
        told = "import os; print(os.environ.get('HIL_TOKEN', 'none'))"
        return really_begin([sys.executable, "-c", told], log)

    monkeypatch.setattr(background_runs, "begin", begin)
    started = start_run(Path("--runs=x.yaml"), tmp_path / "runs", speed="10%", first="30s")
    until(lambda: not started.alive, 20)
    assert given[0][-4:] == ["--speed-scale=10%", "--limit=30s", "--", "--runs=x.yaml"]
    assert started.last_words == ["none"]  # the token is nothing for a run and its plugins


def test_of_a_long_log_only_the_end_is_read(tmp_path: Path) -> None:
    log = tmp_path / "long.log"
    with log.open("wb") as file:
        file.truncate(3 << 30)  # takes no room
        file.seek(0, 2)
        file.write(b"\nthe end\n")
    assert background_runs.last_lines(log)[-1] == "the end"
