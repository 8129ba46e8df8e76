"""After the fits: the studies of a spec, and what is left when one of them fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import hil
from hil.core.errors import DataError, FitError, SpecError, Stopped
from hil.recording.run_directory import RunDirectory
from hil.report.text import summary_lines
from hil.studies.store import read_study, study_files
from hil.workflow.running import RunReport
from hil.workflow.studies import entries_for, run_studies
from tests.support.report_runs import dwell_plan, write_run
from tests.support.study_parts import register

SPEC = """\
hil: 1
name: studied
robot: ur5
excitation: {kind: dwell, waypoints: 2, approach: both}
weigh: false
warm_up: {duration_s: 0}
reference: {every: 0}
"""


SEEN: list[Any] = []
"""Events of the run `done`."""


class Watching:
    """An observer of the engine."""

    def notify(self, event: Any) -> None:
        SEEN.append(event)


def run(root: Path, *studies: str, **options: Any) -> RunReport:
    (root / "spec.yaml").write_text(f"{SPEC}study: [{', '.join(studies)}]\n", "utf-8")
    return hil.run(hil.load(root / "spec.yaml"), runs=root / "runs", **options)


def recorded(root: Path, *studies: str) -> Path:
    """A run that was recorded and not studied, without moving anything."""
    path = write_run(root, dwell_plan(poses=2)).path
    with (path / "spec.yaml").open("a", encoding="utf-8") as spec:
        spec.write(f"study: [{', '.join(studies)}]\n")
    return path


def studied(report: RunReport) -> list[Any]:
    return [read_study(path) for path in study_files(report.run)]


@pytest.fixture(autouse=True)
def _studies(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        root = tmp_path_factory.mktemp("done")
        return run(root, "{study: counted, rounds: 2}", observers=[Watching()])


@pytest.mark.thorough
def test_a_run_makes_the_studies_of_its_spec(done: RunReport) -> None:
    assert (done.outcome, done.error) == ("completed", None)
    (found,) = studied(done)
    assert (found.study, found.parameters) == ("counted", {"rounds": 2, "ending": ""})


def test_whoever_watches_a_run_is_told_fits_that_are_done(done: RunReport) -> None:
    told = [event["ended"] for event in SEEN if "ended" in event]
    assert [(one["number"], one["total"], one["name"]) for one in told] == [
        (1, 2, "a round"),
        (2, 2, "a round"),
    ]


def test_a_study_sees_the_moves_between_the_poses(done: RunReport) -> None:
    (found,) = studied(done)
    (table,) = found.parts[0].tables
    counts = {kind: count for kind, count, _ in table.rows}
    assert counts["dwell"] == 4
    assert counts["move"] >= 2


def test_the_file_is_json_without_nan(done: RunReport) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    text = study_files(done.run)[0].read_text("utf-8")
    assert json.loads(text, parse_constant=refuse)["hil_study"] == 1


def test_page_and_terminal_tell_what_it_comes_to(done: RunReport) -> None:
    assert done.report is not None
    page = done.report.read_text("utf-8")
    assert "Study: Counted series" in page
    assert "Counts again (paper protocol)" in page
    assert "ur5 has" in " ".join(summary_lines(done.run))
    assert hil.api.describe_run(done.run)["studies"].keys() == {
        path.parent.name for path in study_files(done.run)
    }


def test_a_study_made_again_replaces_its_result_and_the_checksums_still_hold(
    done: RunReport,
) -> None:
    (before,) = study_files(done.run)
    hil.study(done.run)
    assert study_files(done.run) == [before]
    assert RunDirectory.open(done.run).verify() == []


@pytest.mark.thorough
def test_other_parameters_stand_beside_it(tmp_path: Path) -> None:
    path = recorded(tmp_path, "{study: counted, rounds: 2}")
    hil.study(path)
    (found,) = hil.study(path, "counted", parameters={"rounds": 4})
    assert found.parameters["rounds"] == 4
    assert len(study_files(path)) == 2


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("ending", "told"),
    [
        ("fails", "the study counted: there are too few poses"),
        ("breaks", "the study counted: counted failed: ZeroDivisionError: division by zero"),
    ],
)
def test_a_study_that_fails_costs_no_other(tmp_path: Path, ending: str, told: str) -> None:
    path = recorded(tmp_path, f"{{study: counted, ending: {ending}}}", "{study: counted}")
    with pytest.raises(FitError) as caught:
        hil.study(path)
    assert caught.value.message == told
    assert [read_study(file).parameters["ending"] for file in study_files(path)] == [""]


@pytest.mark.thorough
def test_a_run_whose_study_fails_is_complete_and_told(tmp_path: Path) -> None:
    report = run(tmp_path, "{study: counted, ending: fails}")
    assert report.outcome == "completed"
    assert isinstance(report.error, FitError)
    assert (report.run / "verdict.json").is_file()
    assert "The study counted failed" in " ".join(summary_lines(report.run))


@pytest.mark.thorough
def test_ctrl_c_leaves_the_run_complete_and_says_how_to_go_on(tmp_path: Path) -> None:
    report = run(tmp_path, "{study: counted}", "{study: counted, ending: ctrl-c}")
    assert isinstance(report.error, Stopped)
    assert report.error.by_signal
    assert report.error.hint == f"compute the missing studies: hil study {report.run}"
    assert RunDirectory.open(report.run).status == "completed"
    assert report.report is not None
    assert len(study_files(report.run)) == 1


def test_progress_is_told_to_observers(done: RunReport) -> None:
    told = [event for event in SEEN if event.get("kind") == "study" and event["study"]]
    assert [event["what"] for event in told] == ["counting"] * len(told)
    assert (told[-1]["study"], told[-1]["done"], told[-1]["total"]) == ("counted", 2, 2)


def test_what_the_spec_asks_for_and_nobody_made_is_the_next_thing_to_do(tmp_path: Path) -> None:
    path = recorded(tmp_path, "{study: counted}")
    text = path.joinpath("spec.yaml").read_text("utf-8")
    path.joinpath("spec.yaml").write_text(text.replace("fit: [", "fit: [] # ["), "utf-8")
    RunDirectory(path).write_verdict({"passed": None, "rows": []})
    assert f"next: hil study {path}" in summary_lines(path)


def test_a_study_is_made_of_a_run_whose_spec_names_none(tmp_path: Path) -> None:
    path = write_run(tmp_path, dwell_plan(poses=2)).path
    with pytest.raises(SpecError, match="names no study"):
        entries_for(path)
    assert [entry.study for entry in entries_for(path, "counted")] == ["counted"]


def test_parameters_for_one_of_several_studies_are_refused(tmp_path: Path) -> None:
    path = recorded(tmp_path, "{study: counted}", "{study: counted, rounds: 1}")
    with pytest.raises(SpecError, match="could belong to any of the studies counted, counted"):
        entries_for(path, None, {"rounds": 9})


def test_a_run_without_recording_is_told_as_what_it_is(done: RunReport, tmp_path: Path) -> None:
    for name in ("start.json", "plan.json", "spec.yaml"):
        (tmp_path / name).symlink_to(done.run / name)
    found = run_studies(tmp_path, entries_for(tmp_path))
    assert isinstance(found.error, DataError)
