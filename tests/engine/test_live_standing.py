"""Where a run stands, and what its events say."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hil.engine.standing import DEBUG, ERROR, INFO, WARNING, Standing, message_of


def standing(*events: dict[str, Any]) -> Standing:
    out = Standing()
    for event in events:
        out.take(event)
    return out


def said(*events: dict[str, Any]) -> tuple[int, str] | None:
    return message_of(events[-1], standing(*events))


def test_keys_an_event_lacks_keep_their_value() -> None:
    run = standing(
        {"kind": "progress", "step": 3, "steps": 9, "doing": "dwell", "gaps": 2},
        {"kind": "progress", "step": 4},
    )
    assert (run.step, run.steps, run.doing, run.gaps) == (4, 9, "dwell", 2)


def test_times_that_are_not_known_yet_change_nothing() -> None:
    run = standing({"kind": "progress", "device_s": float("nan"), "steps": 9, "step": 0})
    json.dumps(run.snapshot(), allow_nan=False)
    assert run.device_s == 0.0


def test_waiting_for_an_answer_is_no_progress() -> None:
    times = {"steps": 9, "duration_s": 100.0, "wall_s": 0.1}
    run = standing(
        {"kind": "progress", "step": 1, "device_s": 10.0, **times},
        {"kind": "prompt", "text": "Mount the disc", "answered_by": ""},
        {"kind": "progress", "step": 1, "device_s": 70.0, **times},
        {"kind": "prompt", "text": "Mount the disc", "answered_by": "ann"},
        {"kind": "progress", "step": 2, "device_s": 75.0, **times},
    )
    assert run.share == pytest.approx(0.15)
    assert run.prompt == ""


def test_prompts_have_numbers_their_own_or_counted() -> None:
    asked: list[dict[str, Any]] = [{"kind": "prompt", "text": "Mount it", "answered_by": ""}] * 2
    answered = {"kind": "prompt", "text": "Mount it", "answered_by": "ann"}
    assert standing(asked[0], answered, asked[0]).asked == 2
    assert standing(asked[0] | {"asked": 3}, answered).asked == 3  # some were not heard of
    assert standing(asked[0]).snapshot()["asked"] == 1


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({"kind": "stage", "stage": "planning"}, (INFO, "planning")),
        ({"kind": "state", "state": "running", "reason": ""}, (INFO, "running")),
        ({"kind": "state", "state": "paused", "reason": "hot"}, (WARNING, "paused: hot")),
        ({"kind": "state", "state": "stopping", "reason": "trip"}, (ERROR, "stopping: trip")),
        ({"kind": "state", "state": "stopping", "reason": ""}, (INFO, "stopping")),
        ({"kind": "prompt", "text": "Mount", "answered_by": ""}, (WARNING, "asking: Mount")),
        ({"kind": "prompt", "text": "Disc", "answered_by": "ann"}, (INFO, "answered by ann: Disc")),
        (
            {"kind": "step", "step": 4, "steps": 9, "doing": "dwell", "pose": 2, "load": 0},
            (DEBUG, "step 5/9 dwell, pose 2"),
        ),
        (
            {"kind": "step", "step": 0, "steps": 9, "doing": "payload", "load": 1},
            (DEBUG, "step 1/9 payload, load 1"),
        ),
        ({"kind": "progress", "step": 4, "steps": 9}, None),
    ],
)  # fmt: skip
def test_events_say_what_they_mean_and_how_bad_it_is(
    event: dict[str, Any], expected: tuple[int, str] | None
) -> None:
    assert said(event) == expected


def test_a_completed_run_ends_without_alarm() -> None:
    step = {"kind": "step", "step": 8, "steps": 9}
    assert said(step, {"kind": "state", "state": "done", "reason": "completed"}) == (
        INFO,
        "done: completed",
    )
