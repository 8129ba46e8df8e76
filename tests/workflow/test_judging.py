"""Verdicts: what is fitted on and judged on, under which loads, and what is never judged."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.core import plugins
from hil.core.errors import DataError, FitError
from hil.data import Conditions, Dataset
from hil.estimators.base import load_model_file
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from hil.evaluation.holdout import NEW_LOAD, NEW_MOTION, assert_new_pairs, hold_out
from hil.evaluation.run_verdict import verdict_word
from hil.recording.run_directory import RunDirectory
from hil.report import render_report
from hil.report.text import summary_lines
from hil.spec.experiment import HoldOut
from hil.spec.load import load_spec
from hil.studies.store import read_study, study_files
from hil.workflow import judging, studies
from hil.workflow.judging import judge_recording, judge_run
from hil.workflow.studies import as_in_spec, entries_for, of_other_arms, run_studies
from tests.support.judging import COUNTS, LOOSE, run_with
from tests.support.load_parts import OFF_AXIS, sweep
from tests.support.report_runs import dwell_plan, fourier_plan, write_run
from tests.support.synthetic_motion import dataset, nominal, raw

# Verdicts: recording and models apart, and a failing fit that costs nobody else


GAPS = "{gaps_percent: {max: 0.1}}"


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


@pytest.fixture
def _estimators(monkeypatch: pytest.MonkeyPatch) -> None:
    real = plugins.entry_points
    mine = [
        EntryPoint("unlucky", "tests.workflow.test_judging:Unlucky", "hil.estimators"),
        EntryPoint("faulty", "tests.workflow.test_judging:Faulty", "hil.estimators"),
    ]
    monkeypatch.setattr(
        plugins,
        "entry_points",
        lambda *, group: [*real(group=group), *(mine if group == "hil.estimators" else ())],
    )


def judged(run: RunDirectory, **counts: int) -> bool | None:
    return judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS | counts)


def verdict_of(run: RunDirectory) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((run.path / "verdict.json").read_text("utf-8"))
    return document


def words(run: RunDirectory) -> tuple[str, str, str]:
    document = verdict_of(run)
    return document["verdict"], document["recording"]["verdict"], document["model"]["verdict"]


@pytest.mark.usefixtures("_estimators")
def test_a_complete_recording_alone_judges_no_model(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept=GAPS)
    assert judged(run) is None
    assert words(run) == ("not judged", "passed", "not judged")
    assert verdict_word(run.path) == "not judged"
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert text.startswith("NOT JUDGED")
    assert "recording passed, model not judged" in text
    assert "the spec sets no criterion for models" in text


@pytest.mark.usefixtures("_estimators")
def test_a_recording_with_gaps_rejects_the_run_whatever_the_model_is_worth(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept="{rmse: {max: 99, unit: A}, gaps_percent: {max: 0.1}}")
    assert judged(run, missing=5) is False
    assert words(run) == ("rejected", "rejected", "passed")


@pytest.mark.usefixtures("_estimators")
def test_model_and_recording_pass_together(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept="{rmse: {max: 99, unit: A}, gaps_percent: {max: 0.1}}")
    assert judged(run) is True
    assert words(run) == ("passed", "passed", "passed")


@pytest.mark.usefixtures("_estimators")
@pytest.mark.parametrize("judge", [judge_run, judge_recording])
def test_a_recording_is_judged_without_any_fit(tmp_path: Path, judge: Any) -> None:
    run = run_with(tmp_path, accept=GAPS)
    spec = load_spec(run.path / "spec.yaml", {"fit": "[]"})
    assert judge(run, spec, COUNTS | {"missing": 5}) is False
    assert words(run) == ("rejected", "rejected", "not judged")


@pytest.mark.usefixtures("_estimators")
def test_a_failing_estimator_is_named_with_its_place_by_a_fit_alone(tmp_path: Path) -> None:
    run = run_with(tmp_path)
    words = r"^faulty failed: ZeroDivisionError: division by zero"
    with pytest.raises(FitError, match=words + r" \(…/test_judging\.py:\d+ in fit\)"):
        hil.fit(run.path, estimator="faulty", out=tmp_path / "models")


@pytest.mark.usefixtures("_estimators")
def test_a_failing_fit_loses_no_other_model_and_says_why(tmp_path: Path) -> None:
    run = run_with(tmp_path, "unlucky static-wls faulty")
    with pytest.raises(FitError) as caught:
        judged(run)
    assert "unlucky: the stars are against it" in caught.value.message
    assert "faulty: it failed: ZeroDivisionError: division by zero" in caught.value.message
    assert re.search(r"\(…/test_judging\.py:\d+ in fit\)", caught.value.message)
    document = verdict_of(run)
    assert document["problems"][0]["hint"] == "wait for another night"
    assert [problem["estimator"] for problem in document["problems"]] == ["unlucky", "faulty"]
    assert [row["estimator"] for row in document["rows"]] == ["static-wls"]
    assert len(list(run.path.glob("fit/static-wls-*/evaluation.json"))) == 1


@pytest.mark.usefixtures("_estimators")
@pytest.mark.thorough
def test_a_run_that_lacks_a_model_does_not_pass_but_may_be_rejected(tmp_path: Path) -> None:
    for accept, word in ((LOOSE, "not judged"), ("{rmse: {max: 1e-6, unit: A}}", "rejected")):
        run = run_with(tmp_path, "unlucky static-wls", accept)
        with pytest.raises(FitError):
            judged(run)
        assert words(run) == (word, "not judged", word)


@pytest.mark.usefixtures("_estimators")
@pytest.mark.thorough
def test_page_and_terminal_say_which_model_is_missing_and_why(tmp_path: Path) -> None:
    run = run_with(tmp_path, "unlucky static-wls")
    with pytest.raises(FitError):
        judged(run)
    said = "unlucky could not be fitted and evaluated: the stars are against it"
    assert said in " ".join(" ".join(summary_lines(run.path)).split())
    assert said in render_report(run.path).read_text("utf-8")


@pytest.mark.usefixtures("_estimators")
def test_a_recording_that_cannot_be_read_is_a_problem_of_the_data(tmp_path: Path) -> None:
    run = run_with(tmp_path, accept=GAPS)
    (run.path / "recording" / "00.mcap").write_bytes(b"nothing")
    with pytest.raises(DataError):
        judged(run)
    assert words(run)[1] == "passed"
    assert len(verdict_of(run)["problems"]) == 1


@pytest.mark.usefixtures("_estimators")
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
    assert "the limit on the mean NRMSE includes shoulder_pan_joint. For these" in told(0.99)


# What is fitted on and what is judged on: loads, motions, and both at once


def series(*conditions: Conditions) -> Dataset:
    """Three rows per series, all different."""
    count = 3 * len(conditions)
    values = np.arange(count * 6, dtype=float).reshape(count, 6)
    columns = {"t": np.arange(count, dtype=float), "q": values, "effort": values + 0.5}
    return dataset(columns, [3] * len(conditions), list(conditions))


def program(kind: str = "trajectory", motions: int = 4, loads: int = 2) -> Dataset:
    """The same motions once with each load, between a warm-up, moves and reference visits."""
    key = {"trajectory": "trajectory", "dwell": "pose"}[kind]
    found = [Conditions("w", "warmup", "run")]
    for load in range(loads):
        for number in range(motions):
            found.append(Conditions(f"m{load}{number}", "move", "run", load=load))
            found.append(Conditions(f"r{load}{number}", "reference", "run", load=load))
            for side in (1, -1) if kind == "dwell" else (0,):
                one = Conditions(f"{kind}{load}{number}{side}", kind, "run", load=load)  # type: ignore[arg-type]
                found.append(replace(one, approach=side, **{key: number}))
    return series(*found)


def pairs(data: Dataset, key: str = "trajectory") -> set[tuple[int, int]]:
    return {(getattr(c, key), c.load) for c in data.conditions}


def test_a_new_load_is_judged_on_motions_seen_with_other_loads_and_said_so() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,)))
    assert pairs(parts.train) == {(n, 0) for n in range(4)}
    assert pairs(parts.test) == {(n, 1) for n in range(4)}
    assert parts.held_out == "load 1, motions of the training data with other payloads"
    assert parts.beside == ()


def test_new_loads_and_new_motions_are_judged_together_and_reported_apart() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,), trajectories=1))
    assert pairs(parts.train) == {(0, 0), (1, 0), (2, 0)}
    assert pairs(parts.test) == {(3, 1)}
    assert parts.held_out == (
        "the last trajectory with load 1: motions and payloads that are not in the training data"
    )
    beside = {what: pairs(data) for what, data in parts.beside}
    assert beside == {NEW_LOAD: {(0, 1), (1, 1), (2, 1)}, NEW_MOTION: {(3, 0)}}


def test_loads_are_called_by_their_mass() -> None:
    data = program(loads=3)
    masses = [0.0, 3.0, 5.0]
    named = [replace(c, payload=Payload(masses[c.load])) for c in data.conditions]
    parts = hold_out(replace(data, conditions=tuple(named)), HoldOut(loads=(2, 1)))
    assert parts.held_out == "3 kg and 5 kg, motions of the training data with other payloads"


@pytest.mark.parametrize("kind", ["trajectory", "dwell"])
@pytest.mark.parametrize("loads", [(), (1,)])
def test_only_what_was_measured_is_fitted_or_judged(kind: str, loads: tuple[int, ...]) -> None:
    parts = hold_out(program(kind), HoldOut(loads=loads))
    kinds = {c.kind for part in (parts.train, parts.test) for c in part.conditions}
    assert kinds == {kind}


def test_a_share_of_the_trajectories_is_drawn_by_seed_with_every_load() -> None:
    data = program(motions=12)
    draws = [hold_out(data, HoldOut(trajectories_percent=25, seed=seed)) for seed in (7, 7, 8)]
    held = [{c.trajectory for c in parts.test.conditions} for parts in draws]
    assert held[0] == held[1] != held[2]
    assert all(len(numbers) == 3 for numbers in held)
    assert pairs(draws[0].test) == {(n, load) for n in held[0] for load in (0, 1)}
    assert pairs(draws[0].train).isdisjoint(pairs(draws[0].test))
    said = ", ".join(str(number) for number in sorted(held[0]))
    assert draws[0].held_out == f"trajectories {said} (drawn, counted from 0)"


@pytest.mark.parametrize(
    ("percent", "total", "held"), [(1, 12, 1), (90, 2, 1), (50, 3, 2), (90, 12, 11), (25, 12, 3)]
)
def test_a_share_holds_out_one_trajectory_at_least_and_leaves_one(
    percent: float, total: int, held: int
) -> None:
    parts = hold_out(program(motions=total, loads=1), HoldOut(trajectories_percent=percent))
    assert len(pairs(parts.test)) == held
    assert len(pairs(parts.train)) == total - held


def test_a_share_and_loads_are_judged_together() -> None:
    parts = hold_out(program(motions=4), HoldOut(loads=(1,), trajectories_percent=25))
    ((number, load),) = pairs(parts.test)
    assert load == 1
    assert pairs(parts.train) == {(n, 0) for n in range(4)} - {(number, 0)}


def test_no_share_with_loads_holds_out_loads_alone() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,), trajectories_percent=0))
    assert pairs(parts.test) == {(n, 1) for n in range(4)}


def test_poses_are_held_out_with_both_approaches_and_all_loads() -> None:
    parts = hold_out(program("dwell", motions=5), HoldOut(poses_percent=40))
    held = {c.pose for c in parts.test.conditions}
    assert len(held) == 2
    assert len(parts.test.conditions) == 2 * 2 * 2
    assert held.isdisjoint(c.pose for c in parts.train.conditions)


def test_poses_under_a_new_load_are_new_themselves_when_asked_for() -> None:
    parts = hold_out(program("dwell", motions=5), HoldOut(loads=(1,), poses_percent=20))
    assert {c.load for c in parts.test.conditions} == {1}
    assert len(parts.test.conditions) == 2
    assert pairs(parts.train, "pose").isdisjoint(pairs(parts.test, "pose"))
    held = {c.pose for c in parts.test.conditions}
    assert held.isdisjoint(c.pose for c in parts.train.conditions)


def test_the_last_trajectories_are_held_out_under_every_load() -> None:
    parts = hold_out(program(motions=5, loads=2), HoldOut(trajectories=2))
    assert pairs(parts.test) == {(3, 0), (4, 0), (3, 1), (4, 1)}
    assert parts.held_out == "the last 2 trajectories"


def test_the_same_motion_under_the_same_load_is_refused() -> None:
    data = program()
    first = data.select(lambda c: c.trajectory in (0, 1) and c.load == 0)
    second = data.select(lambda c: c.trajectory in (1, 2) and c.load == 0)
    with pytest.raises(DataError, match="the first is trajectory 1 with load 0"):
        assert_new_pairs(first, second)


def test_the_same_samples_under_another_load_are_refused() -> None:
    data = program().select(lambda c: c.trajectory == 1 and c.load == 0)
    relabelled = replace(data, conditions=tuple(replace(c, load=1) for c in data.conditions))
    with pytest.raises(DataError, match="samples of the test data are also in the training data"):
        assert_new_pairs(data, relabelled)


@pytest.mark.parametrize("how", [HoldOut(trajectories=0), HoldOut(loads=(7,))])
def test_holding_out_nothing_is_refused(how: HoldOut) -> None:
    with pytest.raises(DataError, match="no data are held out"):
        hold_out(program(), how)


def test_holding_out_everything_is_refused() -> None:
    with pytest.raises(DataError, match="the run has 4 trajectories"):
        hold_out(program(), HoldOut(trajectories=4))


# A model that has seen the target is shown, labelled, and never judged


PAPER = "{estimator: static-wls, form: paper, current_term: true}"
HONEST = "{estimator: static-wls, form: paper}"
LOOSE_AND_WHOLE = "{rmse: {max: 99, unit: A}, gaps_percent: {max: 1}}"
SAYS = "paper: the measured current is among the inputs"


def judged_dwells(
    root: Path, *fits: str, accept: str = LOOSE_AND_WHOLE
) -> tuple[RunDirectory, bool | None]:
    run = write_run(root, dwell_plan(poses=40), accept=accept)
    file = run.path / "spec.yaml"
    text = file.read_text("utf-8")
    file.write_text(text.replace("{estimator: static-wls}", ", ".join(fits)), "utf-8")
    return run, judge_run(run, load_spec(file), COUNTS)


def evaluations(run: RunDirectory) -> list[dict[str, Any]]:
    return [json.loads(f.read_text("utf-8")) for f in run.path.glob("fit/*/evaluation.json")]


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, bool | None]:
    return judged_dwells(tmp_path_factory.mktemp("paper"), PAPER)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, bool | None]:
    return judged_dwells(tmp_path_factory.mktemp("both"), PAPER, HONEST)


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
    assert f"The model is not judged: {SAYS}." in text
    assert "no acceptance criteria" not in text


def test_the_page_labels_it_wherever_it_is_named(both: tuple[RunDirectory, bool | None]) -> None:
    run, _ = both
    page = render_report(run.path).read_text("utf-8")
    assert "(paper protocol)" in page
    assert f"is not a prediction and is not judged; {SAYS}." in page


def test_the_verdict_is_told_of_the_honest_model(both: tuple[RunDirectory, bool | None]) -> None:
    first = " ".join(" ".join(summary_lines(both[0].path)).split()).partition(" run ")[0]
    assert "criteria are met" in first
    assert "paper protocol" not in first


# `validate: {under_loads: true}`: fitted to the first load, judged under all, and judged once


SPEC = """\
hil: 1
name: loads
robot: ur5
excitation: {kind: fourier, trajectories: 4}
loads: [{mass_kg: 0}, {mass_kg: 3}]
fit: [{estimator: rigid-wls}, {estimator: rigid-linear}]
validate: {under_loads: true, hold_out: {trajectories: 2}}
"""
ACCEPT = "accept: {load_error_ratio: {max: 3}, contradicted_loads: {max: 0}}\n"
ONE = SPEC.replace(", {estimator: rigid-linear}", "")
"""Fits a single estimator."""
MOUNTED = OFF_AXIS[1:2]
WRONG = (Payload(3.0, (0.03, -0.055, 0.045), OFF_AXIS[1].inertia),)


@cache
def loads() -> Dataset:
    """A run without and with a load, which no test changes."""
    return raw(sweep(mounted=MOUNTED))


def of_run(path: Path, data: Dataset) -> Dataset:
    conditions = tuple(replace(c, source=str(path)) for c in data.conditions)
    return replace(data, conditions=conditions)


def judged_loads(
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
        yield judged_loads(root, patch, SPEC + ACCEPT, loads())


def verdict(run: RunDirectory) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run.path / "verdict.json").read_text("utf-8"))
    return found


@pytest.mark.thorough
def test_every_estimator_is_fitted_to_the_first_load_alone(done: Any) -> None:
    models = [load_model_file(path.parent) for path in done[0].path.glob("fit/*/model.json")]
    assert {model.estimator for model in models} == {"rigid-wls", "rigid-linear"}
    for model in models:
        assert model.training_ is not None
        for load in range(2):
            rows = loads().select(lambda c, load=load: (c.load, c.trajectory) == (load, 1))
            assert (model.training_.rows.share_known(rows) > 0.5) == (load == 0)


@pytest.mark.thorough
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
    assert judged_loads(tmp_path, monkeypatch, ONE, loads())[2] is None
    assert len(fits) == 2  # the run's own, and one for the other two motions


@pytest.mark.thorough
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
    assert "error under a load relative to the first load ≤ 3" in text
    assert "declared loads contradicted ≤ 0" in text


@pytest.mark.thorough
def test_whoever_watches_is_told_how_far_it_is(done: Any) -> None:
    what = [event["what"] for event in done[1] if event["kind"] == "study" and event["study"]]
    assert set(what) == {"judging rigid-wls under loads", "judging rigid-linear under loads"}
    assert done[1][-1] == {"kind": "study", "study": ""}


@pytest.mark.thorough
def test_the_study_is_made_again_as_it_was(done: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = done[0].path
    monkeypatch.setattr(studies, "load_source", lambda path: of_run(path, loads()))
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
    run, *_ = judged_loads(tmp_path, monkeypatch, ONE + accept, loads())
    (row,) = verdict(run)["rows"]
    assert (row["estimator"], row["passed"]) == ("rigid-wls", False)
    assert " kg declared, " in row["what"]
    assert "; 0 kg, " in row["what"]
    assert verdict(run)["verdict"] == "rejected"


@pytest.mark.thorough
def test_a_load_that_contradicts_its_declaration_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, *_ = judged_loads(
        tmp_path, monkeypatch, ONE + ACCEPT, raw(sweep(mounted=MOUNTED, declared=WRONG))
    )
    (row,) = (row for row in verdict(run)["rows"] if row["metric"] == "contradicted_loads")
    assert (row["what"], row["value"], row["passed"]) == ("run (3 kg)", 1, False)


@pytest.mark.thorough
def test_a_run_that_lacks_loads_says_so_and_keeps_its_models(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = loads().select(lambda c: c.load == 0 or c.trajectory == 4)
    run, _, error = judged_loads(tmp_path, monkeypatch, SPEC + ACCEPT, some)
    assert error is not None
    assert "under loads: 3 kg: no motion remains for its identification" in str(error)
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
    seen = loads().select(lambda c: c.load == 0)
    model = RigidWls().fit(seen, nominal())
    assert model.training_ is not None
    model.training_ = replace(model.training_, serial="A1")
    saved = str(model.save(tmp_path / "model"))
    monkeypatch.setattr(studies, "serial_of", lambda run: "B2")
    (told,) = of_other_arms(tmp_path, [saved])
    assert "BELONGS TO A DIFFERENT ROBOT" in told
    assert "A1" in told
    assert "B2" in told
    monkeypatch.setattr(studies, "serial_of", lambda run: "A1")
    assert of_other_arms(tmp_path, [saved]) == ()
