"""What `hil show` and the report say about the weighing of loads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hil.report import render_report, summary_lines
from tests.support.report_runs import fourier_plan, write_run

FIRST = {"load": 0, "result": "first"}
PASSED = {"load": 1, "result": "passed", "declared_kg": 3.0, "weighed_kg": 3.0654}
PASSED |= {"deviation_kg": 0.0979, "limit_kg": 0.45}
FAILED = PASSED | {
    "result": "failed",
    "weighed_kg": 1.0996,
    "problem": "load 1: 3.00 kg declared, 1.10 ± 0.10 kg weighed against the 0.00 kg of load 0 "
    "(limit ± 0.45 kg)\n  shoulder_lift_joint: 22.7 N·m declared, 8.1 N·m weighed",
}
SKIPPED = {"result": "skipped", "reason": "the robot's drive gains are not known"}


def told(tmp_path: Path, *events: dict[str, Any]) -> str:
    run = write_run(tmp_path, fourier_plan())
    with run.event_log() as log:
        for event in events:
            log.append("weighing", **event)
    return " ".join(" ".join(summary_lines(run.path)).split())


def test_the_page_shows_it_too(tmp_path: Path) -> None:
    told(tmp_path, FIRST, PASSED)
    (run,) = tmp_path.rglob("start.json")
    page = render_report(run.parent).read_text("utf-8")
    assert "3.00 kg declared, 3.07 ± 0.10 kg weighed" in page


def test_a_load_that_was_weighed_is_shown_with_both_masses(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST, PASSED)
    assert "weighed load 1: 3.00 kg declared, 3.07 ± 0.10 kg weighed" in text
    assert "Warning" not in text


def test_a_load_that_was_weighed_again_is_shown_as_it_was_weighed_last(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST, FAILED, FIRST, PASSED)
    assert "3.07 ± 0.10 kg" in text
    assert "1.10 ± 0.10 kg" not in text


def test_a_first_load_that_could_not_be_weighed_at_first_is_told_no_more(tmp_path: Path) -> None:
    failed = {"load": 0, "result": "failed", "problem": "load 0 could not be weighed: no effort"}
    text = told(tmp_path, failed, FIRST, PASSED)
    assert "could not be weighed" not in text
    assert "3.07 ± 0.10 kg" in text


def test_a_waived_weighing_is_a_warning(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST, FAILED | {"result": "waived"})
    warning = text.split("Warning: ")[1]
    assert "was waived: load 1: 3.00 kg declared, 1.10 ± 0.10 kg weighed" in warning
    assert "shoulder_lift_joint" not in warning


def test_a_weighing_that_cannot_tell_is_a_warning(tmp_path: Path) -> None:
    problem = "load 1: 0.10 kg declared, 0.00 ± 0.01 kg weighed"
    doubtful = PASSED | {"result": "inconclusive", "problem": problem}
    text = told(tmp_path, FIRST, doubtful)
    sentence = f"The weighing cannot tell which load is mounted: {problem}."
    assert sentence in text.split("Warning: ")[1]
    (run,) = tmp_path.rglob("start.json")
    assert sentence in render_report(run.parent).read_text("utf-8")


def test_loads_that_were_not_weighed_have_a_reason(tmp_path: Path) -> None:
    assert "weighed loads: not weighed: the robot's drive gains are not known" in told(
        tmp_path, SKIPPED
    )


def test_a_run_without_a_sweep_says_nothing_of_it(tmp_path: Path) -> None:
    assert "weighed" not in told(tmp_path)


@pytest.mark.parametrize("event", [{"result": "passed"}, {"result": "failed"}, {"load": "x"}, {}])
def test_a_damaged_event_breaks_nothing(tmp_path: Path, event: dict[str, Any]) -> None:
    told(tmp_path, event)
