"""Pausing, stopping and answering a run that another process makes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RecordingError, RobotTimeout
from hil.core.lock_file import hold_run, is_live, run_holder
from hil.recording.events import read_events
from hil.recording.run_directory import RunDirectory
from hil.workflow.following import newest_live, only_live
from hil.workflow.live_state import read_live
from hil.workflow.remote_control import (
    MOST_BYTES,
    Control,
    ControlRequest,
    answer_run,
    drop,
    pause_run,
    question_of,
    resume_live_run,
    stop_run,
)
from tests.support.command import hil
from tests.support.live_run import live_run
from tests.support.waiting import until

# What a live run does with the requests that others drop into its directory


class FakeEngine:
    """Notes what it is asked, and on which thread."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str]] = []
        self.threads: set[int] = set()

    def _note(self, what: str, text: str) -> None:
        self.threads.add(threading.get_ident())
        self.asked.append((what, text))

    def request_pause(self, reason: str) -> None:
        self._note("pause", reason)

    def request_resume(self, by: str) -> None:
        self._note("resume", by)

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        assert not by_signal
        self._note("stop", reason)


class FakePrompt:
    """Takes answers to one question."""

    def __init__(self) -> None:
        self.runs: list[Path | None] = []
        self.answers: list[tuple[bool, str]] = []

    def accept_remote_answers(self, run: Path | None) -> None:
        self.runs.append(run)

    def answer(self, yes: bool, who: str, prompt: str, asked: int = 0) -> str:
        if prompt != "Mount it" or asked not in (0, 2):
            return "the run asks something else"
        self.answers.append((yes, who))
        return ""


class Rig:
    """A run directory with a control that is open."""

    def __init__(self, run: Path) -> None:
        self.run = run
        self.engine, self.prompt = FakeEngine(), FakePrompt()
        self.events: list[dict[str, Any]] = []
        self.control = Control(run, self.engine, self.event, self.prompt)

    def event(self, kind: str, **details: Any) -> None:
        self.events.append({"kind": kind, **details})

    def ask(self, what: Any, **details: Any) -> dict[str, Any]:
        """Drop a request; returns the event it became."""
        holder = run_holder(self.run)
        assert holder is not None
        request = ControlRequest(what, "anna", **{"holder": holder.id, **details})
        before, path = len(self.events), drop(self.run, request)
        until(lambda: len(self.events) > before)
        assert not path.exists()
        return self.events[-1]

    def put(self, name: str, content: bytes) -> dict[str, Any]:
        """Put any file there; returns the event it became."""
        before = len(self.events)
        (self.run / ".control" / name).write_bytes(content)
        until(lambda: len(self.events) > before)
        return self.events[-1]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with hold_run(tmp_path):
        rig = Rig(tmp_path)
        with rig.control:
            yield rig


def test_every_request_reaches_the_engine_from_another_thread_and_is_recorded(rig: Rig) -> None:
    paused = rig.ask("pause", reason="lunch")
    rig.ask("resume")
    rig.ask("stop")
    assert rig.engine.asked == [
        ("pause", "asked by anna: lunch"), ("resume", "anna"), ("stop", "stop asked by anna"),
    ]  # fmt: skip
    assert threading.get_ident() not in rig.engine.threads
    assert paused == {"kind": "control", "what": "pause", "who": "anna", "reason": "lunch"}


def test_requests_are_obeyed_in_the_order_they_came(rig: Rig) -> None:
    holder = run_holder(rig.run)
    assert holder is not None
    for what in ("pause", "resume", "pause", "resume", "stop"):
        drop(rig.run, ControlRequest(what, "anna", holder.id))  # type: ignore[arg-type]
    until(lambda: len(rig.engine.asked) == 5)
    whats = [what for what, _ in rig.engine.asked]
    assert whats == ["pause", "resume", "pause", "resume", "stop"]


def test_an_answer_goes_to_the_prompt_it_was_meant_for(rig: Rig) -> None:
    taken = rig.ask("answer", prompt="Mount it", yes=True)
    refused = rig.ask("answer", prompt="Remove it", yes=True)
    assert rig.prompt.answers == [(True, "anna")]
    assert (taken["yes"], taken["prompt"], "problem" in taken) == (True, "Mount it", False)
    assert refused["problem"] == "the run asks something else"


def test_an_answer_brings_the_number_of_its_prompt_and_need_not(rig: Rig) -> None:
    problems = [
        rig.ask("answer", prompt="Mount it", yes=True, asked=asked).get("problem")
        for asked in (1, 2, 0)
    ]
    assert problems == ["the run asks something else", None, None]
    holder = run_holder(rig.run)
    assert holder is not None
    old = {"what": "answer", "who": "a", "holder": holder.id, "prompt": "Mount it", "yes": True}
    assert "problem" not in rig.put("1.json", json.dumps(old).encode())  # by an older `hil answer`


def test_what_was_meant_for_an_earlier_attempt_is_not_obeyed(rig: Rig) -> None:
    event = rig.ask("stop", holder="the one that died")
    assert event["problem"] == "meant for an earlier attempt"
    assert rig.engine.asked == []


def test_a_stop_asked_for_while_a_resumed_run_connects_is_obeyed(tmp_path: Path) -> None:
    (tmp_path / ".control").mkdir()  # left by an attempt that died, with a request to it
    drop(tmp_path, ControlRequest("pause", "bert", "the one that died"))
    with hold_run(tmp_path):
        holder = run_holder(tmp_path)
        assert holder is not None
        drop(tmp_path, ControlRequest("stop", "anna", holder.id))
        rig = Rig(tmp_path)
        with rig.control:
            assert len(rig.events) == 2  # at once: what comes next may be the arm's first motion
    assert rig.engine.asked == [("stop", "stop asked by anna")]
    assert rig.events[0]["problem"] == "meant for an earlier attempt"
    assert list(tmp_path.glob(".control")) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"what": "fly", "who": "a", "holder": "b"}',
        b'{"what": "stop"}', b'{"what": ["stop"], "who": "a", "holder": "b"}',
        b'{"what": "stop", "who": 3, "holder": "b"}',
        b'{"what": "answer", "who": "a", "holder": "b", "yes": "yes"}',
        b'{"what": "answer", "who": "a", "holder": "b", "yes": 1}',
        b'{"what": "answer", "who": "a", "holder": "b", "asked": true}',
        b"[" * MOST_BYTES, b'{"what": "stop", "who": "' + b"a" * MOST_BYTES + b'"}',
    ],
)  # fmt: skip
def test_nonsense_is_removed_recorded_and_does_no_harm(content: bytes, rig: Rig) -> None:
    event = rig.put("nonsense.json", content)
    assert event["problem"].startswith("not a request")
    assert len(event["problem"]) < 300
    assert list((rig.run / ".control").iterdir()) == []
    rig.ask("stop")
    assert rig.engine.asked == [("stop", "stop asked by anna")]


def test_unfinished_requests_are_left_alone(rig: Rig) -> None:
    (rig.run / ".control" / ".draft.json").write_text("{")
    rig.ask("pause")
    assert len(rig.events) == 1


def test_texts_of_others_are_safe_on_a_terminal(rig: Rig) -> None:
    rig.ask("pause", reason="\x1b[2Jgone\n" + "x" * 1000)
    ((_, reason),) = rig.engine.asked
    assert reason.isprintable()
    assert len(reason) < 250


def test_a_log_that_has_failed_keeps_nobody_from_stopping(rig: Rig) -> None:
    def full(kind: str, **details: Any) -> None:
        raise RecordingError("no space left on device")

    rig.control._event = full
    holder = run_holder(rig.run)
    assert holder is not None
    drop(rig.run, ControlRequest("pause", "anna", holder.id))
    drop(rig.run, ControlRequest("stop", "anna", holder.id))
    until(lambda: [what for what, _ in rig.engine.asked] == ["pause", "stop"])


def test_an_engine_that_raises_still_hears_the_next_request(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(reason: str) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(rig.engine, "request_pause", broken)
    assert "a bug" in rig.ask("pause")["problem"]
    rig.ask("stop")
    assert rig.engine.asked == [("stop", "stop asked by anna")]


def test_listening_ends_with_the_run_and_leaves_nothing(tmp_path: Path) -> None:
    with hold_run(tmp_path):
        rig = Rig(tmp_path)
        with rig.control:
            holder = run_holder(tmp_path)
        rig.control.close()
        assert holder is not None
        with pytest.raises(DataError, match="does not accept requests"):
            drop(tmp_path, ControlRequest("stop", "anna", holder.id))
    assert rig.prompt.runs == [tmp_path, None]
    assert list(tmp_path.iterdir()) == []


def test_a_prompt_that_takes_no_answers_says_so(tmp_path: Path) -> None:
    with hold_run(tmp_path):
        rig = Rig(tmp_path)
        rig.control = Control(tmp_path, rig.engine, rig.event, lambda text, meanwhile: "mock")
        with rig.control:
            event = rig.ask("answer", prompt="Mount it", yes=True)
    assert event["problem"] == "the run accepts no answers from other processes"


def test_a_request_is_whole_when_it_appears(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.control.close()
    (rig.run / ".control").mkdir()
    path = drop(rig.run, ControlRequest("stop", "anna", "h", reason="smoke"))
    assert json.loads(path.read_text()) == {
        "what": "stop", "who": "anna", "holder": "h", "reason": "smoke", "prompt": "", "yes": False,
        "asked": 0,
    }  # fmt: skip
    assert len(list(path.parent.iterdir())) == 1


# Pausing, stopping and answering a run that lives in another process


def moving(run: Path) -> bool:
    return read_live(run).get("state") == "running"


def controls(run: Path) -> list[dict[str, Any]]:
    return [event for event in read_events(run / "events.jsonl") if event["kind"] == "control"]


@pytest.mark.wire
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


@pytest.mark.wire
def test_a_prompt_is_answered_from_another_terminal(tmp_path: Path) -> None:
    with live_run(tmp_path, "Mount the 3 kg disc") as (run, _):
        until(lambda: read_live(run).get("prompt"))
        assert answer_run(run, True, who="anna").state == "running"
        until(lambda: moving(run))
        with pytest.raises(DataError, match="has no open prompt"):
            answer_run(run, True, who="anna")
        stop_run(run, who="anna")
    (prompt,) = [e for e in read_events(run / "events.jsonl") if e["kind"] == "prompt"]
    assert prompt["answered_by"] == "anna"


@pytest.mark.wire
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


@pytest.mark.wire
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


@pytest.mark.wire
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


@pytest.mark.wire
def test_a_run_that_died_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not is_live(run)
        with pytest.raises(DataError, match="is not active: its status is interrupted") as caught:
            stop_run(run, who="anna")
    assert caught.value.hint == f"continue the run: hil resume {run}"


@pytest.mark.wire
def test_a_suspended_process_does_not_react_and_the_request_is_withdrawn(tmp_path: Path) -> None:
    with live_run(tmp_path) as (run, process):
        until(lambda: moving(run))
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(RobotTimeout, match="does not react: the request to stop was withdrawn"):
            stop_run(run, who="anna", wait_s=0.4)
        assert list((run / ".control").iterdir()) == []
        process.send_signal(signal.SIGCONT)


@pytest.mark.wire
def test_a_run_that_does_not_listen_yet_says_so(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "early")
    run.write_start({"uid": "u"})
    with hold_run(run.path), pytest.raises(DataError, match="does not accept requests"):
        pause_run(run.path, who="anna", wait_s=0.2)


def watching(run: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "hil", "watch", str(run), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.wire
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
    assert f"{run}: interrupted: the process died at step" in told
    assert told.endswith(f"next: hil resume {run}\n")
    assert watcher.returncode == 1


@pytest.mark.wire
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
