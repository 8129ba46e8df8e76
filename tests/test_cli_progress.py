"""Progress lines: what a person reads while a run goes on."""

from __future__ import annotations

from typing import Any

import pytest

from hil.cli.progress import ProgressLines


def progress(step: int, steps: int, device_s: float, wall_s: float = 0.1) -> dict[str, Any]:
    return {
        "kind": "progress",
        "step": step,
        "steps": steps,
        "doing": "dwell",
        "device_s": device_s,
        "wall_s": wall_s,
        "duration_s": 100.0,
    }


def told(capsys: pytest.CaptureFixture[str], *events: dict[str, Any]) -> list[str]:
    lines = ProgressLines()
    for event in events:
        lines.notify(event)
    return capsys.readouterr().err.splitlines()


def test_last_step_is_100_percent_however_long_the_dwells_took(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (line,) = told(capsys, progress(39, 40, 93.0))
    assert line.startswith("100 %  step 40/40")
    assert "left" not in line


def test_a_run_that_takes_longer_than_planned_is_not_done_before_its_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (line,) = told(capsys, progress(38, 40, 120.0))
    assert line.startswith(" 99 %")


def test_a_run_of_one_step_ends_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(told(capsys, progress(0, 1, 1.0, wall_s=0.0))) == 1


def test_speed_is_told_against_real_time(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = told(capsys, progress(39, 40, 100.0, wall_s=2.0))
    assert "(50× real time), took 2.0 s" in line


def test_a_pipe_gets_a_line_now_and_then_and_the_last_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = told(capsys, *(progress(i, 40, 2.0 * i) for i in range(40)))
    assert [line[:4] for line in lines] == ["  0 ", "100 "]
