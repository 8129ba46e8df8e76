"""A process that died between the motion and the report: `hil resume` always ends at a report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, FitError, Rejected
from hil.recording.recovery import recover
from hil.recording.run_directory import RESERVE, RunDirectory, reserve
from hil.runs.listing import list_runs
from tests.support.study_parts import register

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 12, seed: 3}
warm_up: {duration_s: 2}
reference: {every: 0}
accept: {rmse: {max: 5, unit: A, per: joint}}
fit: [{estimator: static-wls}]
study: [{study: counted}]
"""


@pytest.fixture(autouse=True)
def _studies(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that came to its end, with models, a study and a report."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "small.yaml").write_text(SPEC, "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        report = hil.run(hil.load(folder / "small.yaml"), runs=folder / "runs")
    assert report.error is None
    return report.run


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged as a kill would."""
    return Path(shutil.copytree(whole, tmp_path / "runs" / Path(*whole.parts[-3:])))


def remove(run: Path, *patterns: str) -> None:
    """Remove what the process had not written yet."""
    for pattern in patterns:
        found = list(run.glob(pattern))
        assert found, pattern
        for path in found:
            path.unlink()


def before_stop(run: Path) -> None:
    remove(run, "stop.json", "verdict.json", "report.html", "fit/*/*", "study/*/*")
    (recording,) = RunDirectory(run).recordings
    recording.rename(f"{recording}.partial")
    reserve(run)


LEFT: dict[str, Callable[[Path], None]] = {
    "before the stop document": before_stop,
    "before the fit": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/*", "study/*/*"
    ),
    "between the files of a model": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/*.safetensors", "fit/*/evaluation.json"
    ),
    "between a model and its evaluation": lambda run: remove(
        run, "verdict.json", "report.html", "fit/*/evaluation.json", "study/*/*"
    ),
    "before the verdict": lambda run: remove(run, "verdict.json", "report.html", "study/*/*"),
    "before the studies": lambda run: remove(run, "report.html", "study/*/*"),
    "before the report": lambda run: remove(run, "report.html"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("moment", LEFT)
def test_a_run_that_was_killed_after_its_motion_is_resumed_to_its_report(
    run: Path, moment: str
) -> None:
    models = {path: path.read_bytes() for path in run.glob("fit/*/model.safetensors")}
    verdict = json.loads((run / "verdict.json").read_text())
    LEFT[moment](run)
    (listed,) = list_runs(run.parents[2])
    assert listed["next"] == f"hil resume {run}"

    report = hil.resume(run)

    assert report.error is None
    assert report.outcome == "completed"
    assert report.report == run / "report.html"
    assert "INTERRUPTED" not in report.report.read_text("utf-8")
    assert {path: path.read_bytes() for path in run.glob("fit/*/model.safetensors")} == models
    assert json.loads((run / "verdict.json").read_text())["rows"] == verdict["rows"]
    assert len(list(run.glob("study/*/study.json"))) == 1
    assert RunDirectory(run).status == "completed"
    assert not (run / RESERVE).exists()
    (listed,) = list_runs(run.parents[2])
    assert listed["next"] == ""
    with pytest.raises(DataError, match="judged and reported"):
        hil.resume(run)


def test_a_verdict_stays_as_it_is_and_only_what_is_missing_is_made(run: Path) -> None:
    kept = {p: p.stat().st_mtime_ns for p in run.rglob("*.json")}
    remove(run, "report.html")
    hil.resume(run)
    assert {p: p.stat().st_mtime_ns for p in run.rglob("*.json")} == kept


def edited_verdict(run: Path, **values: object) -> None:
    verdict = json.loads((run / "verdict.json").read_text())
    (run / "verdict.json").write_text(json.dumps(verdict | values))


@pytest.mark.thorough
def test_a_rejected_run_is_rejected_when_only_its_report_is_written(run: Path) -> None:
    edited_verdict(run, passed=False)
    remove(run, "report.html")
    error = CliRunner().invoke(app, ["resume", str(run)]).exception
    assert isinstance(error, Rejected)
    assert (run / "report.html").is_file()


def test_a_model_that_could_not_be_fitted_is_still_missing_when_the_report_is_written(
    run: Path,
) -> None:
    problem = {"estimator": "static-mlp-lm", "error": "too few dwells", "hint": "record more"}
    edited_verdict(run, problems=[problem])
    remove(run, "report.html")
    report = hil.resume(run)
    assert isinstance(report.error, FitError)
    assert report.error.message == "static-mlp-lm: too few dwells"
    assert report.error.hint == "record more"
    assert report.report is not None


def test_a_report_from_before_the_verdict_is_not_taken_for_that_of_the_verdict(run: Path) -> None:
    """A stopped run has a report; one that was resumed may die between verdict and report."""
    verdict = json.loads((run / "verdict.json").read_text())
    remove(run, "verdict.json")
    (run / "report.html").write_text("stopped at step 3")
    RunDirectory(run).write_verdict(verdict)
    assert not (run / "report.html").exists()
    assert hil.resume(run).report is not None


def test_recover_gives_the_reserve_back_that_a_kill_left(run: Path) -> None:
    before_stop(run)
    recover(run)
    assert not (run / RESERVE).exists()


def test_a_recovery_that_writes_elsewhere_leaves_the_run_untouched(
    run: Path, tmp_path: Path
) -> None:
    before_stop(run)
    recover(run, tmp_path / "elsewhere")
    assert (run / RESERVE).exists()


def test_runs_names_the_next_command_by_number_where_one_is_left(run: Path) -> None:
    runs = run.parents[2]

    def table() -> list[str]:
        return CliRunner().invoke(app, ["runs", "--runs", str(runs)]).output.splitlines()

    assert "next" not in table()[0]
    remove(run, "report.html")
    header, row = table()
    assert header.split()[-1] == "next"
    assert row.endswith(f"hil resume 1 --runs {runs}")
