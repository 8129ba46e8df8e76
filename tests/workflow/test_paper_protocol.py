"""A model that has seen the target is shown, labelled, and never judged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hil.recording.run_directory import RunDirectory
from hil.report import render_report
from hil.report.text import summary_lines
from hil.spec.load import load_spec
from hil.workflow.judging import judge_run
from tests.support.report_runs import dwell_plan, write_run

COUNTS = {"samples": 1000, "gaps": 0, "missing": 0, "duplicates": 0, "overruns": 0}
PAPER = "{estimator: static-wls, form: paper, current_term: true}"
HONEST = "{estimator: static-wls, form: paper}"
LOOSE = "{rmse: {max: 99, unit: A}, gaps_percent: {max: 1}}"
SAYS = "paper: the measured current is among the inputs"


def judged(root: Path, *fits: str, accept: str = LOOSE) -> tuple[RunDirectory, bool | None]:
    run = write_run(root, dwell_plan(poses=40), accept=accept)
    file = run.path / "spec.yaml"
    text = file.read_text("utf-8")
    file.write_text(text.replace("{estimator: static-wls}", ", ".join(fits)), "utf-8")
    return run, judge_run(run, load_spec(file), COUNTS)


def evaluations(run: RunDirectory) -> list[dict[str, Any]]:
    return [json.loads(f.read_text("utf-8")) for f in run.path.glob("fit/*/evaluation.json")]


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, bool | None]:
    return judged(tmp_path_factory.mktemp("paper"), PAPER)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, bool | None]:
    return judged(tmp_path_factory.mktemp("both"), PAPER, HONEST)


def test_met_criteria_do_not_make_it_pass(paper: tuple[RunDirectory, bool | None]) -> None:
    run, passed = paper
    verdict = json.loads((run.path / "verdict.json").read_text("utf-8"))
    assert passed is verdict["passed"] is None
    assert verdict["not_judged"] == [{"estimator": "static-wls", "protocol": SAYS}]
    assert [row["metric"] for row in verdict["rows"]] == ["gaps_percent"]


def test_its_evaluation_says_so(paper: tuple[RunDirectory, bool | None]) -> None:
    (document,) = evaluations(paper[0])
    assert document["protocol"] == SAYS
    assert document["verdict"] == {"verdict": "not judged", "passed": None, "rows": []}


def test_a_bad_recording_is_still_rejected(tmp_path: Path) -> None:
    tight = "{rmse: {max: 99, unit: A}, gaps_percent: {max: 0}}"
    run = write_run(tmp_path, dwell_plan(poses=40), accept=tight)
    file = run.path / "spec.yaml"
    text = file.read_text("utf-8").replace("{estimator: static-wls}", PAPER)
    file.write_text(text, "utf-8")
    assert judge_run(run, load_spec(file), COUNTS | {"missing": 5}) is False


def test_an_honest_model_beside_it_is_judged(both: tuple[RunDirectory, bool | None]) -> None:
    run, passed = both
    assert passed is True
    words = {one["protocol"]: one["verdict"]["verdict"] for one in evaluations(run)}
    assert words == {"honest": "pass", SAYS: "not judged"}


def test_the_terminal_labels_it_and_says_why(paper: tuple[RunDirectory, bool | None]) -> None:
    text = " ".join(" ".join(summary_lines(paper[0].path)).split())
    assert text.startswith("NOT JUDGED")
    assert "static-wls (paper protocol): RMSE" in text
    assert f"It is not judged: {SAYS}." in text
    assert "no acceptance criteria" not in text


def test_the_page_labels_it_wherever_it_is_named(both: tuple[RunDirectory, bool | None]) -> None:
    run, _ = both
    page = render_report(run.path).read_text("utf-8")
    assert "(paper protocol)" in page
    assert f"is no prediction and is not judged; {SAYS}." in page


def test_the_verdict_is_told_of_the_honest_model(both: tuple[RunDirectory, bool | None]) -> None:
    first = " ".join(" ".join(summary_lines(both[0].path)).split()).partition(" run ")[0]
    assert "criteria are met" in first
    assert "paper protocol" not in first
