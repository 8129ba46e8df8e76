"""Verdicts: recording and models apart, and a failing fit that costs nobody else."""

from __future__ import annotations

import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

import hil
from hil.core import plugins
from hil.core.errors import DataError, FitError
from hil.estimators.static_model import StaticWls
from hil.evaluation.run_verdict import verdict_word
from hil.recording.run_directory import RunDirectory
from hil.report import render_report
from hil.report.text import summary_lines
from hil.spec.load import load_spec
from hil.workflow.judging import judge_recording, judge_run
from tests.support.report_runs import dwell_plan, write_run

COUNTS = {"samples": 1000, "gaps": 0, "missing": 0, "duplicates": 0, "overruns": 0}
GAPS = "{gaps_percent: {max: 0.1}}"
LOOSE = "{rmse: {max: 99, unit: A}}"


class Unlucky(StaticWls):
    """Finds no solution."""

    estimator = "unlucky"

    def fit(self, dataset: Any, robot: Any) -> Any:
        raise FitError("the stars are against it", hint="wait for another night")


class Faulty(StaticWls):
    """Has a bug."""

    estimator = "faulty"

    def fit(self, dataset: Any, robot: Any) -> Any:
        raise ZeroDivisionError("division by zero")


@pytest.fixture(autouse=True)
def _estimators(monkeypatch: pytest.MonkeyPatch) -> None:
    real = plugins.entry_points
    mine = [
        EntryPoint("unlucky", "tests.workflow.test_verdict:Unlucky", "hil.estimators"),
        EntryPoint("faulty", "tests.workflow.test_verdict:Faulty", "hil.estimators"),
    ]
    monkeypatch.setattr(
        plugins,
        "entry_points",
        lambda *, group: [*real(group=group), *(mine if group == "hil.estimators" else ())],
    )


def run_with(root: Path, fits: str = "static-wls", accept: str = LOOSE) -> RunDirectory:
    run = write_run(root, dwell_plan(poses=40), accept=accept)
    file = run.path / "spec.yaml"
    named = ", ".join(f"{{estimator: {name}}}" for name in fits.split())
    file.write_text(file.read_text("utf-8").replace("{estimator: static-wls}", named), "utf-8")
    return run


def judged(run: RunDirectory, **counts: int) -> bool | None:
    return judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS | counts)


def verdict_of(run: RunDirectory) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((run.path / "verdict.json").read_text("utf-8"))
    return document


def words(run: RunDirectory) -> tuple[str, str, str]:
    document = verdict_of(run)
    return document["verdict"], document["recording"]["verdict"], document["model"]["verdict"]


def test_a_complete_recording_alone_judges_no_model(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept=GAPS)
    assert judged(run) is None
    assert words(run) == ("not judged", "passed", "not judged")
    assert verdict_word(run.path) == "not judged"
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert text.startswith("NOT JUDGED")
    assert "recording passed, model not judged" in text
    assert "the spec sets no criterion for models" in text


def test_a_recording_with_gaps_rejects_the_run_whatever_the_model_is_worth(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept="{rmse: {max: 99, unit: A}, gaps_percent: {max: 0.1}}")
    assert judged(run, missing=5) is False
    assert words(run) == ("rejected", "rejected", "passed")


def test_model_and_recording_pass_together(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept="{rmse: {max: 99, unit: A}, gaps_percent: {max: 0.1}}")
    assert judged(run) is True
    assert words(run) == ("passed", "passed", "passed")


@pytest.mark.parametrize("judge", [judge_run, judge_recording])
def test_a_recording_is_judged_without_any_fit(tmp_path: Path, judge: Any) -> None:
    run = run_with(tmp_path, accept=GAPS)
    spec = load_spec(run.path / "spec.yaml", {"fit": "[]"})
    assert judge(run, spec, COUNTS | {"missing": 5}) is False
    assert words(run) == ("rejected", "rejected", "not judged")


def test_a_failing_estimator_is_named_with_its_place_by_a_fit_alone(tmp_path: Path) -> None:
    run = run_with(tmp_path)
    words = r"^faulty broke down: ZeroDivisionError: division by zero"
    with pytest.raises(FitError, match=words + r" \(…/test_verdict\.py:\d+ in fit\)"):
        hil.fit(run.path, estimator="faulty", out=tmp_path / "models")


def test_a_failing_fit_loses_no_other_model_and_says_why(tmp_path: Path) -> None:
    run = run_with(tmp_path, "unlucky static-wls faulty")
    with pytest.raises(FitError) as caught:
        judged(run)
    assert "unlucky: the stars are against it" in caught.value.message
    assert "faulty: it broke down: ZeroDivisionError: division by zero" in caught.value.message
    assert re.search(r"\(…/test_verdict\.py:\d+ in fit\)", caught.value.message)
    document = verdict_of(run)
    assert document["problems"][0]["hint"] == "wait for another night"
    assert [problem["estimator"] for problem in document["problems"]] == ["unlucky", "faulty"]
    assert [row["estimator"] for row in document["rows"]] == ["static-wls"]
    assert len(list(run.path.glob("fit/static-wls-*/evaluation.json"))) == 1


@pytest.mark.thorough
def test_a_run_that_lacks_a_model_does_not_pass_but_may_be_rejected(tmp_path: Path) -> None:
    for accept, word in ((LOOSE, "not judged"), ("{rmse: {max: 1e-6, unit: A}}", "rejected")):
        run = run_with(tmp_path, "unlucky static-wls", accept)
        with pytest.raises(FitError):
            judged(run)
        assert words(run) == (word, "not judged", word)


@pytest.mark.thorough
def test_page_and_terminal_say_which_model_is_missing_and_why(tmp_path: Path) -> None:
    run = run_with(tmp_path, "unlucky static-wls")
    with pytest.raises(FitError):
        judged(run)
    said = "unlucky could not be fitted and judged: the stars are against it"
    assert said in " ".join(" ".join(summary_lines(run.path)).split())
    assert said in render_report(run.path).read_text("utf-8")


def test_a_recording_that_cannot_be_read_is_a_problem_of_the_data(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept=GAPS)
    (run.path / "recording" / "00.mcap").write_bytes(b"nothing")
    with pytest.raises(DataError):
        judged(run)
    assert words(run)[1] == "passed"
    assert len(verdict_of(run)["problems"]) == 1


def test_a_limit_on_the_mean_nrmse_warns_of_joints_without_signal(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept="{nrmse: {max: 99}}")
    judged(run)
    file = next(run.path.glob("fit/*/evaluation.json"))
    document = json.loads(file.read_text("utf-8"))

    def told(first_joint: float) -> str:
        document["trained"]["total"]["nrmse"] = [first_joint, *[0.2] * 5]
        file.write_text(json.dumps(document), "utf-8")
        return " ".join(" ".join(summary_lines(run.path)).split())

    assert "NRMSE includes" not in told(0.3)
    assert "the limit on the mean NRMSE includes shoulder_pan_joint, where" in told(0.99)
