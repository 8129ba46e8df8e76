"""The live view: a small file that others may read while a run goes on."""

from __future__ import annotations

import json
import math
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.errors import RecordingError
from hil.engine import Observers, observers
from hil.engine.interlocks import Margin
from hil.robot import Capabilities
from hil.workflow import live_state
from hil.workflow.live_state import ArmView, LiveState, read_live, standing_in
from tests.support.interlock_parts import NAMES, made, rows

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
