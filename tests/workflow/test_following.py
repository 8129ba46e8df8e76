"""Following a run from outside: its events, its live view, and how it ended."""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli.progress import WatchLines, end_line, live_line
from hil.core.errors import DataError, RecordingError
from hil.core.lock_file import hold_run
from hil.engine import Observers, observers
from hil.engine.interlocks import Margin
from hil.engine.standing import words_of
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities
from hil.workflow import live_state
from hil.workflow.following import EventTail, follow, how_it_ended, newest_live, only_live
from hil.workflow.live_state import ArmView, LiveState, read_live, standing_in
from tests.support.interlock_parts import NAMES, made, rows

# Following a run from outside: its events and view as they come, and how it ended


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
    assert end["reason"] == "the process died at step 12 of 50; the recorded data are kept"
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
    with pytest.raises(DataError, match="no run is active"):
        newest_live(tmp_path)
    begun(tmp_path)
    first, second = begun(tmp_path), begun(tmp_path)
    with hold_run(first.path):
        assert only_live(tmp_path) == first.path
        with hold_run(second.path):
            assert newest_live(tmp_path) == second.path
            with pytest.raises(DataError, match="2 runs are active"):
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
        ({"prompt": "Mount it"}, "prompt: Mount it  step 12/50 dwell, pose 5"),
        ({"step": -2}, " 25 %  returning to the plan  1 min 15 s left"),
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
        ({"kind": "asked", "text": "Mount it"}, "question: Mount it (answer: hil answer R yes)"),
        ({"kind": "prompt", "text": "Mount it", "answered_by": ""}, "answered by no operator"),
        ({"kind": "prompt", "text": "Mount it", "answered_by": "anna", "answer": "no"},
         "anna answered no"),
        ({"kind": "trip", "reason": "too hot"}, "tripped: too hot"),
        ({"kind": "control", "what": "stop", "who": "anna", "problem": "too late"},
         "request from anna: stop (refused: too late)"),
        ({"kind": "control", "what": "unknown", "problem": "not a request"},
         "request from an unknown client: unknown (refused: not a request)"),
        ({"kind": "weighing", "load": 0, "result": "first", "half_difference_nm": [[4.7]]},
         "payload check of load 0: reference for the other loads"),
        ({"kind": "weighing", "load": 1, "result": "passed", "weighed_kg": 3.0},
         "payload check of load 1: passed"),
        ({"kind": "weighing", "load": 1, "result": "waived", "problem": "2 kg instead of 3"},
         "payload check of load 1: waived: 2 kg instead of 3"),
        ({"kind": "weighing", "result": "skipped", "reason": "no gains"},
         "no payload check: no gains"),
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


# The live view: a small file that others may read while a run goes on


PROGRESS: dict[str, Any] = {
    "kind": "progress", "step": 11, "steps": 50, "doing": "dwell", "pose": 5, "trajectory": -1,
    "device_s": 25.0, "wall_s": 25.0, "duration_s": 100.0, "samples": 3125, "state": "running",
    "gaps": 1, "missing": 2, "duplicates": 0, "overruns": 0, "behind_s": 0.1,
}  # fmt: skip
ROBOT = Capabilities(joint_names=NAMES, rate_hz=125.0, effort_kind="current")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Monotonic time, to be moved."""
    now = [100.0]
    monkeypatch.setattr(live_state.time, "monotonic", lambda: now[0])
    return now


def test_the_view_says_where_the_run_is(tmp_path: Path, clock: list[float]) -> None:
    live = LiveState(tmp_path)
    for state in ("preflight", "armed", "running"):
        live.notify({"kind": "state", "state": state, "reason": ""})
    clock[0] += 1.0
    live.notify(PROGRESS)
    view = json.loads((tmp_path / ".live.json").read_text())
    kept = {key: value for key, value in PROGRESS.items() if key != "kind"}
    assert kept.items() <= view.items()
    assert (view["pid"], view["percent"], view["left_s"]) == (os.getpid(), 25.0, 75.0)
    assert view["updated"].endswith("+00:00")


def test_progress_is_written_four_times_a_second_and_news_at_once(
    tmp_path: Path, clock: list[float]
) -> None:
    live = LiveState(tmp_path)
    steps = []
    for step in range(30):
        live.notify(PROGRESS | {"step": step})
        steps.append(read_live(tmp_path)["step"])
        clock[0] += 0.025
    assert len(set(steps)) == 3
    live.notify(PROGRESS | {"step": 30})
    live.notify({"kind": "state", "state": "paused", "reason": "asked by anna"})
    assert (read_live(tmp_path)["step"], read_live(tmp_path)["state"]) == (30, "paused")


def test_a_question_stands_there_until_it_is_answered(tmp_path: Path) -> None:
    live = LiveState(tmp_path)
    live.notify({"kind": "prompt", "text": "Mount it", "answered_by": ""})
    assert read_live(tmp_path)["prompt"] == "Mount it"
    live.notify({"kind": "prompt", "text": "Mount it", "answered_by": "nobody"})
    assert read_live(tmp_path)["prompt"] == ""


def test_the_view_goes_with_the_run_and_does_not_come_back(tmp_path: Path) -> None:
    live = LiveState(tmp_path)
    live.notify({"kind": "stage", "stage": "running"})
    live.close()
    live.notify({"kind": "stage", "stage": "late"})
    live.close()
    assert list(tmp_path.iterdir()) == []
    assert read_live(tmp_path) == {}


def test_the_view_says_how_the_arm_is_and_what_is_near_its_limit(tmp_path: Path) -> None:
    live = LiveState(tmp_path, ArmView(ROBOT, [made(kind="speed", limit_deg_s=90)]))
    live.notify({"kind": "state", "state": "running", "reason": ""})
    block = rows(3, moving=True, q=0.5, qd=0.1, effort=1.5, temperature=np.nan)
    block["qd"][-1, 2] = np.pi / 4
    live.notify({"kind": "rows", "rows": block})
    view = read_live(tmp_path)
    arm, (speed,) = view["arm"], view["interlocks"]
    assert (arm["joints"], arm["effort_unit"], arm["moving"]) == (list(NAMES), "A", True)
    assert (arm["q_rad"], arm["effort"]) == ([0.5] * 6, [1.5] * 6)
    assert arm["temperature_c"] == [None] * 6  # nobody measures it
    assert arm["device_time_s"] == pytest.approx(2 / 125)
    assert (speed["name"], speed["subject"], speed["unit"]) == ("speed", "j3", "°/s")
    assert (speed["value"], speed["limit"], speed["share"]) == pytest.approx((45, 90, 0.5))
    live.notify({"kind": "state", "state": "done", "reason": "completed"})
    assert "arm" not in read_live(tmp_path)


def test_the_view_is_given_four_blocks_a_second_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(observers.time, "monotonic", lambda: now[0])
    live, given = LiveState(tmp_path), []
    monkeypatch.setattr(live, "notify", given.append)
    watching = Observers((live,))
    for _ in range(500):
        watching.publish_rows(rows(1))
        now[0] += 0.002
    watching.close()
    assert len(given) == 4


def test_a_full_disk_does_not_end_the_watching(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = LiveState(tmp_path)
    with monkeypatch.context() as patch:

        def full(*arguments: Any) -> None:
            raise RecordingError("no space left on device")

        patch.setattr(live_state, "write_replacing", full)
        live.notify({"kind": "stage", "stage": "first"})
    live.notify({"kind": "stage", "stage": "second"})
    assert read_live(tmp_path)["stage"] == "second"


def test_a_reader_never_sees_half_a_view(tmp_path: Path) -> None:
    live, over, seen = LiveState(tmp_path), threading.Event(), []

    def read() -> None:
        while not over.is_set():
            seen.append(read_live(tmp_path).get("stage", ""))

    live.notify({"kind": "stage", "stage": "0"})
    reader = threading.Thread(target=read)
    reader.start()
    for i in range(200):
        live.notify({"kind": "stage", "stage": str(i)})
    over.set()
    reader.join()
    assert "" not in seen


def test_one_part_that_cannot_be_told_hides_no_other(tmp_path: Path) -> None:
    class Broken:
        name, action = "broken", "stop"

        def margin(self, block: Any) -> None:
            raise ZeroDivisionError

    class Whole(Broken):
        name = "whole"

        def margin(self, block: Any) -> Any:
            return Margin(1.0, 2.0, "m", 0.5, joint=-1)

    view = ArmView(ROBOT, [])
    view._interlocks = [Broken(), Whole()]  # type: ignore[list-item]
    live = LiveState(tmp_path, view)
    live.notify({"kind": "rows", "rows": rows(1)})
    (whole,) = read_live(tmp_path)["interlocks"]
    assert (whole["name"], whole["subject"]) == ("whole", "")  # no joint is not the last one
    live.notify({"kind": "rows", "rows": np.zeros(1)})  # no rows of any arm
    assert "arm" not in read_live(tmp_path)
    live.notify({"kind": "prompt", "text": "Mount it", "answered_by": ""})
    assert read_live(tmp_path)["prompt"] == "Mount it"


def test_only_finite_numbers_and_texts_are_taken_from_a_view(tmp_path: Path) -> None:
    odd = {"step": math.nan, "steps": 1e999, "samples": 10**400, "device_s": 1e999, "gaps": True,
           "prompt": ["x"], "state": 3, "t": math.inf, "wall_s": 2, "stage": "running",
           "arm": {"q_rad": [1e999, 0.5, {}], "joints": ["a", "b", "c"], "effort": {}},
           "interlocks": [3, {"name": "speed", "share": 1e999, "unit": "m"}]}  # fmt: skip
    (tmp_path / ".live.json").write_text(json.dumps(odd))
    view = read_live(tmp_path)
    keys = ("qd_rad_s", "effort", "temperature_c", "q_target_rad")
    unknown: dict[str, list[None]] = {key: [None] * 3 for key in keys}
    assert view == {"wall_s": 2, "stage": "running",
                    "arm": {"joints": ["a", "b", "c"], "q_rad": [None, 0.5, None], **unknown},
                    "interlocks": [{"name": "speed", "unit": "m"}]}  # fmt: skip
    for told in (view, odd):
        standing = standing_in(told)
        assert (standing.step, standing.samples, standing.device_s) == (-1, 0, 0.0)
        assert (standing.gaps, standing.prompt, standing.stage) == (0, "", "running")


@pytest.mark.parametrize("content", ["", "[]", "{", '{"step": "three", "reason": 7}'])
def test_a_damaged_view_says_nothing(content: str, tmp_path: Path) -> None:
    (tmp_path / ".live.json").write_text(content)
    standing = standing_in(read_live(tmp_path))
    assert (standing.step, standing.reason) == (-1, "")
