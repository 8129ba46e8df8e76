"""What a live run does with the requests that others drop into its directory."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RecordingError
from hil.core.lock_file import hold_run, run_holder
from hil.workflow.remote_control import MOST_BYTES, Control, ControlRequest, drop
from tests.support.waiting import until


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
        with pytest.raises(DataError, match="does not listen"):
            drop(tmp_path, ControlRequest("stop", "anna", holder.id))
    assert rig.prompt.runs == [tmp_path, None]
    assert list(tmp_path.iterdir()) == []


def test_a_prompt_that_takes_no_answers_says_so(tmp_path: Path) -> None:
    with hold_run(tmp_path):
        rig = Rig(tmp_path)
        rig.control = Control(tmp_path, rig.engine, rig.event, lambda text, meanwhile: "mock")
        with rig.control:
            event = rig.ask("answer", prompt="Mount it", yes=True)
    assert event["problem"] == "the run takes no answers from elsewhere"


def test_a_request_is_whole_when_it_appears(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.control.close()
    (rig.run / ".control").mkdir()
    path = drop(rig.run, ControlRequest("stop", "anna", "h", reason="smoke"))
    assert json.loads(path.read_text()) == {
        "what": "stop", "who": "anna", "holder": "h", "reason": "smoke", "prompt": "", "yes": False,
        "asked": 0,
    }  # fmt: skip
    assert len(list(path.parent.iterdir())) == 1
