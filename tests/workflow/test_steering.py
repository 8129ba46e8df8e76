"""Pausing, stopping and answering a run that lives in another process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RobotTimeout
from hil.core.lock_file import hold_run, is_live
from hil.recording.events import read_events
from hil.recording.run_directory import RunDirectory
from hil.workflow.following import newest_live, only_live
from hil.workflow.live_state import read_live
from hil.workflow.remote_control import (
    answer_run,
    pause_run,
    question_of,
    resume_live_run,
    stop_run,
)
from tests.support.command import hil
from tests.support.live_run import live_run
from tests.support.waiting import until

pytestmark = pytest.mark.wire


def moving(run: Path) -> bool:
    return read_live(run).get("state") == "running"


def controls(run: Path) -> list[dict[str, Any]]:
    return [event for event in read_events(run / "events.jsonl") if event["kind"] == "control"]


def test_a_run_pauses_goes_on_and_stops_when_asked(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        paused = pause_run(run, who="anna", reason="lunch")
        assert (paused.state, paused.reason) == ("paused", "asked by anna: lunch")
        assert paused.steps > paused.step >= 0
        again = resume_live_run(run, who="anna")
        assert again.state == "running"
        stopped = stop_run(run, who="bert", reason="smoke")
        assert (stopped.state, stopped.reason) == ("stopped", "stop asked by bert: smoke")
        assert process.wait(60) == 0
    assert RunDirectory.open(run).status == "stopped"
    asked = [(event["what"], event["who"], event.get("reason")) for event in controls(run)]
    assert asked == [
        ("pause", "anna", "lunch"),
        ("resume", "anna", None),
        ("stop", "bert", "smoke"),
    ]
    assert [path.name for path in run.iterdir() if path.name.startswith(".")] == []


def test_a_prompt_is_answered_from_another_terminal(tmp_path: Path) -> None:
    with live_run(tmp_path, "Mount the 3 kg disc") as (run, _):
        until(lambda: read_live(run).get("prompt"))
        assert answer_run(run, True, who="anna").state == "running"
        until(lambda: moving(run))
        with pytest.raises(DataError, match="asks nothing"):
            answer_run(run, True, who="anna")
        stop_run(run, who="anna")
    (prompt,) = [e for e in read_events(run / "events.jsonl") if e["kind"] == "prompt"]
    assert prompt["answered_by"] == "anna"


def test_an_answer_is_to_the_question_that_was_read_and_no_later_one(tmp_path: Path) -> None:
    with live_run(tmp_path, "Mount it", "twice") as (run, _):
        until(lambda: read_live(run).get("asked") == 1)
        first = question_of(run)
        assert answer_run(run, True, who="anna", asked=first).state == "running"
        until(lambda: read_live(run).get("asked") == 2)
        assert read_live(run)["prompt"] == "Mount it"
        answer_run(run, True, who="anna", asked=first, wait_s=0)  # a double click
        until(lambda: len(controls(run)) == 2)
        assert controls(run)[-1]["problem"] == "prompt 1 is closed; prompt 2 is open"
        assert read_live(run)["prompt"] == "Mount it"
        answer_run(run, True, who="anna")  # as `hil answer`: what it asks now
        until(lambda: moving(run))
        stop_run(run, who="anna")


def test_a_no_stops_the_run(tmp_path: Path) -> None:
    with live_run(tmp_path, "Mount the 3 kg disc") as (run, process):
        until(lambda: read_live(run).get("prompt"))
        assert answer_run(run, False, who="bert").state == "stopped"
        process.wait(60)
    assert RunDirectory.open(run).status == "stopped"
    assert [(event["who"], event["yes"]) for event in controls(run)] == [("bert", False)]
    (prompt,) = [e for e in read_events(run / "events.jsonl") if e["kind"] == "prompt"]
    assert (prompt["answered_by"], prompt["answer"]) == ("bert", "no")
    stop = RunDirectory.open(run).stop
    assert stop is not None
    assert stop["reason"] == "bert answered no: 'Mount the 3 kg disc'"


def test_the_verbs_speak_json_and_find_the_only_live_run(tmp_path: Path) -> None:
    with live_run(tmp_path, "Mount the 3 kg disc") as (run, _):
        until(lambda: read_live(run).get("prompt"))
        assert hil("answer", run, "yes", "--operator", "bert").stdout.startswith(f"{run}: running")
        until(lambda: moving(run))
        assert newest_live(tmp_path) == only_live(tmp_path) == run
        paused = hil("pause", "--runs", tmp_path, "--json")
        assert paused.returncode == 0, paused.stderr
        document = json.loads(paused.stdout)
        assert (document["run"], document["state"]) == (str(run), "paused")
        stopped = hil("stop", run.name, "--runs", tmp_path)
        assert stopped.returncode == 0
        assert stopped.stdout.startswith(f"{run}: stopped at step ")


def test_a_run_that_died_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not is_live(run)
        with pytest.raises(DataError, match="is not live: it is interrupted") as caught:
            stop_run(run, who="anna")
    assert caught.value.hint == f"go on with it: hil resume {run}"


def test_a_suspended_process_does_not_react_and_the_request_is_withdrawn(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(RobotTimeout, match="does not react: the request to stop was withdrawn"):
            stop_run(run, who="anna", wait_s=0.4)
        assert list((run / ".control").iterdir()) == []
        process.send_signal(signal.SIGCONT)


def test_a_run_that_does_not_listen_yet_says_so(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "early")
    run.write_start({"uid": "u"})
    with hold_run(run.path), pytest.raises(DataError, match="does not listen"):
        pause_run(run.path, who="anna", wait_s=0.2)


def watching(run: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "hil", "watch", str(run), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_watch_follows_a_run_in_a_pipe_and_survives_its_death(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        with watching(run, "--exit-code") as watcher:
            assert watcher.stdout is not None
            lines = [watcher.stdout.readline() for _ in range(5)]
            process.send_signal(signal.SIGKILL)
            out, err = watcher.communicate(timeout=20)
    told = "".join(lines) + out
    assert err == ""
    assert "checkpoint" in told
    assert "dwell settled" in told
    assert " left\n" in told
    assert f"{run}: interrupted: its process died at step" in told
    assert told.endswith(f"next: hil resume {run}\n")
    assert watcher.returncode == 1


def test_watch_prints_json_lines_and_ctrl_c_ends_the_watching_alone(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        with watching(run, "--json") as watcher:
            assert watcher.stdout is not None
            kinds = {json.loads(watcher.stdout.readline())["kind"] for _ in range(20)}
            watcher.send_signal(signal.SIGINT)
            _, err = watcher.communicate(timeout=20)
        assert kinds == {"event", "live"}
        assert (watcher.returncode, err) == (0, "")
        assert process.poll() is None
        assert is_live(run)
