"""`validate: {under_loads: true}`: fitted to the first load, judged under all, and judged once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil.arms.payload import Payload
from hil.core.errors import FitError
from hil.data.dataset import Dataset
from hil.estimators.base import load_model_file
from hil.estimators.rigid_linear import RigidWls
from hil.recording.run_directory import RunDirectory
from hil.report.text import summary_lines
from hil.spec.load import load_spec
from hil.studies.store import read_study, study_files
from hil.workflow import judging, studies
from hil.workflow.judging import judge_run
from hil.workflow.studies import as_in_spec, entries_for, of_other_arms, run_studies
from tests.support.load_parts import OFF_AXIS, sweep
from tests.support.report_runs import fourier_plan, write_run
from tests.support.synthetic_motion import nominal, raw

COUNTS = {"samples": 1000, "gaps": 0, "missing": 0, "duplicates": 0, "overruns": 0}
SPEC = """\
hil: 1
name: loads
robot: ur5
excitation: {kind: fourier, trajectories: 4}
loads: [{mass_kg: 0}, {mass_kg: 1}, {mass_kg: 3}, {mass_kg: 5}]
fit: [{estimator: rigid-wls}, {estimator: rigid-linear}]
validate: {under_loads: true, hold_out: {trajectories: 2}}
"""
ACCEPT = "accept: {load_error_ratio: {max: 3}, contradicted_loads: {max: 0}}\n"
WRONG = (OFF_AXIS[0], Payload(3.0, (0.03, -0.055, 0.045), OFF_AXIS[1].inertia), OFF_AXIS[2])


def of_run(path: Path, data: Dataset) -> Dataset:
    conditions = tuple(replace(c, source=str(path)) for c in data.conditions)
    return replace(data, conditions=conditions)


def judged(
    root: Path, patch: pytest.MonkeyPatch, spec: str, data: Dataset
) -> tuple[RunDirectory, list[Any], Exception | None]:
    run = write_run(root, fourier_plan())
    (run.path / "spec.yaml").write_text(spec, "utf-8")
    patch.setattr(judging, "load_source", lambda path: of_run(run.path, data))
    told: list[Any] = []
    try:
        judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS, told.append)
    except FitError as error:
        return run, told, error
    return run, told, None


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        root = tmp_path_factory.mktemp("done")
        yield judged(root, patch, SPEC + ACCEPT, raw(sweep()))


def verdict(run: RunDirectory) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run.path / "verdict.json").read_text("utf-8"))
    return found


@pytest.mark.thorough
def test_every_estimator_is_fitted_to_the_first_load_alone(done: Any) -> None:
    models = [load_model_file(path.parent) for path in done[0].path.glob("fit/*/model.json")]
    assert {model.estimator for model in models} == {"rigid-wls", "rigid-linear"}
    for model in models:
        assert model.training_ is not None
        for load in range(4):
            rows = raw(sweep()).select(lambda c, load=load: (c.load, c.trajectory) == (load, 1))
            assert (model.training_.rows.share_known(rows) > 0.5) == (load == 0)


def test_the_study_is_of_the_models_that_were_fitted(done: Any) -> None:
    (file,) = study_files(done[0].path)
    found = read_study(file)
    names = sorted(path.name for path in done[0].path.glob("fit/rigid-*"))
    assert sorted(found.parameters["models"]) == [f"fit/{name}" for name in names]
    assert found.parameters["models"][0].startswith("fit/rigid-wls-")
    assert found.parts[0].tables[0].title.endswith("by rigid-wls")
    assert found.seconds > 0.0


@pytest.mark.thorough
def test_nothing_is_fitted_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fits = []
    real = RigidWls.fit

    def counted(self: RigidWls, *of: Any) -> Any:
        fits.append(self)
        return real(self, *of)

    monkeypatch.setattr(RigidWls, "fit", counted)
    spec = SPEC.replace(", {estimator: rigid-linear}", "")
    assert judged(tmp_path, monkeypatch, spec, raw(sweep()))[2] is None
    assert len(fits) == 2  # the run's own, and one for the other two motions


def test_the_verdict_has_a_row_for_every_model_and_one_for_the_declarations(done: Any) -> None:
    rows = verdict(done[0])["rows"]
    told = [(row["metric"], row["estimator"], row["passed"]) for row in rows]
    assert told == [
        ("load_error_ratio", "rigid-wls", True),
        ("load_error_ratio", "rigid-linear", True),
        ("contradicted_loads", "rigid-wls", True),
    ]
    assert 1.0 < rows[0]["value"] < 3.0
    assert verdict(done[0])["verdict"] == "passed"
    text = " ".join(" ".join(summary_lines(done[0].path)).split())
    assert "error under a load over that with the first ≤ 3" in text
    assert "declared loads contradicted ≤ 0" in text


def test_whoever_watches_is_told_how_far_it_is(done: Any) -> None:
    what = [event["what"] for event in done[1] if event["kind"] == "study" and event["study"]]
    assert set(what) == {"judging rigid-wls under loads", "judging rigid-linear under loads"}
    assert done[1][-1] == {"kind": "study", "study": ""}


@pytest.mark.thorough
def test_the_study_is_made_again_as_it_was(done: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = done[0].path
    monkeypatch.setattr(studies, "load_source", lambda path: of_run(path, raw(sweep())))
    before = read_study(study_files(path)[0])
    again = run_studies(path, entries_for(path, "load-validation"))
    (folder, found) = again.made[0]
    assert [folder / "study.json"] == list(study_files(path))
    assert found.parts[0].tables
    assert read_study(folder / "study.json").parts[0].tables == before.parts[0].tables


@pytest.mark.thorough
def test_the_first_alone_may_have_to_keep_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    accept = "accept: {load_error_ratio: {max: 0.5, of: first}}\n"
    run, *_ = judged(tmp_path, monkeypatch, SPEC + accept, raw(sweep()))
    (row,) = verdict(run)["rows"]
    assert (row["estimator"], row["passed"]) == ("rigid-wls", False)
    assert " kg declared, " in row["what"]
    assert "; 0 kg, " in row["what"]
    assert verdict(run)["verdict"] == "rejected"


@pytest.mark.thorough
def test_a_load_that_contradicts_its_declaration_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, *_ = judged(tmp_path, monkeypatch, SPEC + ACCEPT, raw(sweep(declared=WRONG)))
    (row,) = (row for row in verdict(run)["rows"] if row["metric"] == "contradicted_loads")
    assert (row["what"], row["value"], row["passed"]) == ("run (3 kg)", 1, False)


@pytest.mark.thorough
def test_a_run_that_lacks_loads_says_so_and_keeps_its_models(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = raw(sweep()).select(lambda c: c.load == 0 or c.trajectory == 4)
    run, _, error = judged(tmp_path, monkeypatch, SPEC + ACCEPT, some)
    assert error is not None
    assert "under loads: 1 kg: no motion is left to identify it from" in str(error)
    assert len(list(run.path.glob("fit/*/evaluation.json"))) == 2
    assert verdict(run)["problems"][0]["estimator"] == "under loads"
    assert list(run.path.glob("study/*/problem.json"))


def test_the_same_is_asked_with_the_settings_of_the_spec(tmp_path: Path) -> None:
    file = tmp_path / "spec.yaml"
    tuned = SPEC.replace("{estimator: rigid-wls}", "{estimator: rigid-wls, weighted: false}")
    file.write_text(tuned, "utf-8")
    asked = as_in_spec(load_spec(file), {"estimators": ["rigid-wls", "rigid-irls"]})
    wls = {"estimator": "rigid-wls", "weighted": False}
    assert asked == {"estimators": [wls, "rigid-irls"], "hold_out": 2}


def test_a_model_of_another_individual_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = raw(sweep()).select(lambda c: c.load == 0)
    model = RigidWls().fit(seen, nominal())
    assert model.training_ is not None
    model.training_ = replace(model.training_, serial="A1")
    saved = str(model.save(tmp_path / "model"))
    monkeypatch.setattr(studies, "serial_of", lambda run: "B2")
    (told,) = of_other_arms(tmp_path, [saved])
    assert "OF ANOTHER ROBOT" in told
    assert "A1" in told
    assert "B2" in told
    monkeypatch.setattr(studies, "serial_of", lambda run: "A1")
    assert of_other_arms(tmp_path, [saved]) == ()
