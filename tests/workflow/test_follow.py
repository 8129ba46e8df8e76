"""Following a run from outside: its events and view as they come, and how it ended."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.cli.progress import WatchLines, end_line, live_line
from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.engine.standing import words_of
from hil.recording.run_directory import RunDirectory
from hil.workflow.following import EventTail, follow, how_it_ended, newest_live, only_live
from hil.workflow.live_state import LiveState


def begun(tmp_path: Path, name: str = "dwell") -> RunDirectory:
    run = RunDirectory.create(tmp_path, "ur5", name)
    run.write_start({"uid": "u-1"})
    return run


def test_a_tail_gives_every_event_once_and_waits_for_whole_lines(tmp_path: Path) -> None:
    log = tmp_path / "events.jsonl"
    tail = EventTail(log)
    assert tail.read() == []
    log.write_bytes(b'{"kind": "a"}\n{"kind": ')
    assert tail.read() == [{"kind": "a"}]
    with log.open("ab") as file:
        file.write('"b", "text": "größer"}\nrubbish\n\xff\n[1]\n{"kind": "c"}\n'.encode("latin-1"))
    assert [event["kind"] for event in tail.read()] == ["c"]
    with log.open("ab") as file:
        file.write('{"kind": "d", "text": "größer"}\n'.encode())
    assert tail.read() == [{"kind": "d", "text": "größer"}]
    assert tail.read() == []


def test_a_tail_begins_at_the_end_or_at_the_start(tmp_path: Path) -> None:
    log = tmp_path / "events.jsonl"
    log.write_bytes(b'{"kind": "old"}\n')
    late, all_of_it = EventTail(log), EventTail(log, from_start=True)
    assert late.read() == []
    assert all_of_it.read() == [{"kind": "old"}]


def script(*acts: Callable[[], object]) -> Callable[[float], None]:
    """A `sleep` in which things happen, one each time."""
    todo = list(acts)

    def sleep(seconds: float) -> None:
        todo.pop(0)()

    return sleep


def test_a_run_is_followed_to_its_end(tmp_path: Path) -> None:
    run = begun(tmp_path)
    live, holding = LiveState(run.path), hold_run(run.path)
    holding.__enter__()
    log = run.event_log()

    def end() -> None:
        log.append("trip", reason="too hot")
        log.close()
        run.write_stop("tripped", "too hot")
        live.close()
        holding.__exit__(None, None, None)

    def pause() -> None:
        live.notify({"kind": "state", "state": "paused", "reason": "lunch"})

    items = list(follow(run.path, sleep=script(pause, lambda: None, end)))
    assert [item["kind"] for item in items] == ["live", "event", "end"]
    assert items[0]["state"] == "paused"
    assert items[1]["event"]["reason"] == "too hot"
    assert (items[2]["status"], items[2]["reason"], items[2]["exit_code"]) == (
        "tripped", "too hot", 5,
    )  # fmt: skip


def test_a_run_that_died_is_interrupted_and_told_where(tmp_path: Path) -> None:
    run = begun(tmp_path)
    progress = {"kind": "progress", "step": 11, "steps": 50, "device_s": 1.0, "wall_s": 1.0}
    LiveState(run.path).notify(progress)
    (end,) = follow(run.path)
    assert (end["status"], end["exit_code"]) == ("interrupted", 1)
    assert end["reason"] == "its process died at step 12 of 50; what was recorded is kept"
    assert end_line(end).endswith(f"next: hil resume {run.path}")


@pytest.mark.parametrize(
    ("outcome", "document", "code"),
    [
        ("completed", {}, 0), ("stopped", {}, 6), ("stopped", {"exit_code": 130}, 130),
        ("tripped", {}, 5), ("failed", {}, 4), ("failed", {"exit_code": 7}, 7),
    ],
)  # fmt: skip
def test_the_exit_code_is_the_runs_own(
    outcome: Any, document: dict[str, Any], code: int, tmp_path: Path
) -> None:
    run = begun(tmp_path)
    run.write_stop(outcome, "", document)
    assert how_it_ended(run)["exit_code"] == code


def test_a_rejected_model_ends_in_10(tmp_path: Path) -> None:
    run = begun(tmp_path)
    run.write_json("verdict.json", {"passed": False})
    run.write_stop("completed", "")
    end = how_it_ended(run)
    assert end["exit_code"] == 10
    assert end_line({"kind": "end", **end}).endswith(": completed, model rejected")


def test_the_live_runs_are_found(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no run is live"):
        newest_live(tmp_path)
    begun(tmp_path)
    first, second = begun(tmp_path), begun(tmp_path)
    with hold_run(first.path):
        assert only_live(tmp_path) == first.path
        with hold_run(second.path):
            assert newest_live(tmp_path) == second.path
            with pytest.raises(DataError, match="2 runs are live"):
                only_live(tmp_path)


# --- what is printed -----------------------------------------------------------------------------

VIEW: dict[str, Any] = {
    "kind": "live", "state": "running", "step": 11, "steps": 50, "doing": "dwell", "pose": 5,
    "device_s": 25.0, "wall_s": 25.0, "duration_s": 100.0, "reason": "", "t": 4e9,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, " 25 %  step 12/50 dwell, pose 5  1 min 15 s left"),
        ({"gaps": 2.0, "duplicates": 1, "behind_s": 1.5},
         " 25 %  2 gaps  1 duplicate  recorder 1.5 s behind  step 12/50 dwell, pose 5  "
         "1 min 15 s left"),
        ({"state": "paused", "reason": "lunch"}, "paused: lunch  step 12/50 dwell, pose 5"),
        ({"prompt": "Mount it"}, "asks: Mount it  step 12/50 dwell, pose 5"),
        ({"step": -2}, " 25 %  on the way back  1 min 15 s left"),
        ({"state": "done", "stage": "fitting static-wls"}, "fitting static-wls"),
        ({"state": "stopping", "reason": "smoke"}, "stopping: smoke"),
    ],
)  # fmt: skip
def test_one_line_says_what_matters(changes: dict[str, Any], told: str) -> None:
    assert live_line(VIEW | changes) == told


def test_a_view_that_grows_old_says_so() -> None:
    assert "no news for" in live_line(VIEW | {"t": 0.0})


@pytest.mark.parametrize(
    ("event", "told"),
    [
        ({"kind": "state", "state": "paused", "reason": "lunch"}, "paused: lunch"),
        ({"kind": "checkpoint", "step": 11}, "step 12: checkpoint"),
        ({"kind": "dwell", "step": 11, "settled": False, "elapsed_s": 3.0},
         "step 12: dwell did not settle in 3.00 s"),
        ({"kind": "asked", "text": "Mount it"}, "asks: Mount it (answer: hil answer R yes)"),
        ({"kind": "prompt", "text": "Mount it", "answered_by": ""}, "answered by nobody"),
        ({"kind": "prompt", "text": "Mount it", "answered_by": "anna", "answer": "no"},
         "anna answered no"),
        ({"kind": "trip", "reason": "too hot"}, "tripped: too hot"),
        ({"kind": "control", "what": "stop", "who": "anna", "problem": "too late"},
         "anna asked to stop (not done: too late)"),
        ({"kind": "control", "what": "unknown", "problem": "not a request"},
         "somebody asked to unknown (not done: not a request)"),
        ({"kind": "weighing", "load": 0, "result": "first", "half_difference_nm": [[4.7]]},
         "load 0 weighed: the others are compared with it"),
        ({"kind": "weighing", "load": 1, "result": "passed", "weighed_kg": 3.0},
         "load 1 weighed: passed"),
        ({"kind": "weighing", "load": 1, "result": "waived", "problem": "2 kg instead of 3"},
         "load 1 weighed: waived: 2 kg instead of 3"),
        ({"kind": "weighing", "result": "skipped", "reason": "no gains"},
         "loads are not weighed: no gains"),
        ({"kind": "weighed", "t": 1.0, "mass_kg": 3.1}, "weighed mass_kg=3.1"),
        ({"kind": "dwell", "step": "?"}, "dwell step=?"),
        ({"kind": "trip", "reason": "\x1b[2J"}, "tripped: ?[2J"),
    ],
)  # fmt: skip
def test_events_are_told_in_words(event: dict[str, Any], told: str) -> None:
    assert words_of(event, "R") == told


def test_a_pipe_gets_every_event_but_progress_now_and_then(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = [0.0]
    lines = WatchLines("R", terminal=False, now=lambda: now[0])
    for i in range(40):
        lines.show(VIEW | {"device_s": float(i)})
        now[0] += 1.0
    lines.show({"kind": "event", "event": {"kind": "checkpoint", "step": 1, "t": 0.0}})
    out = capsys.readouterr().out
    assert "\r" not in out
    assert len(out.splitlines()) == 5
    assert out.splitlines()[-1].endswith("step 2: checkpoint")


def test_a_narrow_terminal_gets_one_moving_line_and_the_news(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    lines = WatchLines("R", terminal=True)
    for gaps in range(5):
        lines.show(VIEW | {"gaps": gaps, "duplicates": 1000})
    lines.show({"kind": "event", "event": {"kind": "checkpoint", "step": 1, "t": 0.0}})
    lines.show({"kind": "event", "event": {"kind": "trip", "reason": "hot " * 20, "t": 0.0}})
    out = capsys.readouterr().out
    parts = out.split("\r\x1b[K")
    assert len(parts) == 6
    assert max(len(part) for part in parts[:5]) <= 39
    assert "tripped: hot hot" in parts[5]
    assert max(len(line) for line in parts[5].splitlines()) <= 39
