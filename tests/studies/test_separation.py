"""The static separation study: what it shows, and of data that are not as they should be."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression

import hil
from hil.core import json_document
from hil.core.errors import FitError, SpecError
from hil.data.dataset import Dataset, rows_of
from hil.data.splits import group_of
from hil.dynamics import load_model
from hil.estimators.static_model import paper_functions
from hil.studies.base import silent, study
from hil.studies.figure import Figure
from hil.studies.result import Part, StudyResult, Table, faults_of
from hil.studies.separation_data import (
    by_pose,
    by_sample,
    dwells_in,
    one_per_pose,
    pairs,
    recording_of,
    rows_in,
    sample_noise,
)
from hil.studies.separation_honest import METHOD_KEYS, HonestProtocol, fit_tasks, known_methods
from hil.studies.store import read_study, study_files
from hil.studies.tasks import Task, run_tasks
from tests.support.paths import DOCS, EXPERIMENTS
from tests.support.separation_parts import FRICTION, SAMPLES, program, robot
from tests.support.study_parts import assert_figures_survive_json

# The static separation study: what it shows, and that its honest part is honest


SMALL: dict[str, Any] = {
    "epochs": 40,
    "layouts": [[4, 2, 1]],
    "layout": [4, 10, 10, 1],
    "folds": 2,
    "jobs": 1,
}
MOCK_SPEC = """\
hil: 1
name: separation
robot: ur5
excitation: {kind: dwell, waypoints: 16, approach: both, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
study:
  - {study: static-separation, layouts: [[4, 1]], layout: [4, 2, 1], epochs: 3, folds: 2, jobs: 1}
"""
PAGE = DOCS / "reference" / "studies.md"
SPEC = EXPERIMENTS / "ur5_static_separation.yaml"


@pytest.fixture(scope="module")
def data() -> Dataset:
    return program(60, kept=False)


@pytest.fixture(scope="module")
def told() -> list[tuple[str, int, int]]:
    return []


@pytest.fixture(scope="module")
def found(data: Dataset, told: list[tuple[str, int, int]]) -> StudyResult:
    return study("static-separation", **SMALL).run(
        data, robot(), lambda *progress: told.append(progress)
    )


def part(found: StudyResult, title: str) -> Part:
    return next(part for part in found.parts if part.title == title)


def table(found: StudyResult, key: str) -> Table:
    return next(table for part in found.parts for table in part.tables if table.key == key)


def figure(found: StudyResult, key: str) -> Figure:
    return next(figure for part in found.parts for figure in part.figures if figure.key == key)


def cell(of: Table, row: str, column: str) -> Any:
    return next(values for values in of.rows if values[0] == row)[of.columns.index(column)]


def methods(*keys: str) -> list[Any]:
    known = known_methods(alpha=0.001, weights="paper", layout=(4, 3, 1), epochs=3, seed=0)
    return [known[key] for key in keys]


@pytest.mark.thorough
def test_the_result_can_be_shown_and_survives_json(found: StudyResult) -> None:
    assert faults_of(found) == []
    again = StudyResult.from_dict(json.loads(json_document(found.to_dict())))
    assert table(again, "table-4").rows == table(found, "table-4").rows
    assert_figures_survive_json(found)


@pytest.mark.thorough
def test_both_protocols_stand_side_by_side_and_are_labelled(found: StudyResult) -> None:
    protocols = {part.title: part.protocol for part in found.parts}
    assert protocols["Honest"] == "honest"
    assert protocols["As in the paper"].startswith("paper: ")


@pytest.mark.thorough
def test_all_tables_and_figures_of_the_paper_are_there(found: StudyResult) -> None:
    tables = {table.key for part in found.parts for table in part.tables}
    figures = {figure.key for part in found.parts for figure in part.figures}
    assert {"table-2", "table-3", "table-4", "table-split", "table-honest"} <= tables
    assert figures == {
        "fig-3", "fig-4", "fig-5", "fig-7", "fig-8", "fig-4h", "fig-5h", "fig-7h", "fig-8h",
        "fig-band",
    }  # fmt: skip


@pytest.mark.thorough
def test_the_page_about_studies_lists_the_tables_and_figures_there_are(found: StudyResult) -> None:
    section = PAGE.read_text("utf-8").partition("## `static-separation`")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `((?:table|fig)-.+?) \|", section, re.MULTILINE)
    listed = {key.strip("`") for row in rows for key in row.split(", ")}
    made = {one.key for part in found.parts for one in (*part.tables, *part.figures)}
    assert listed == made


@pytest.mark.thorough
def test_no_panel_has_more_points_than_a_page_shows(found: StudyResult) -> None:
    for one in part(found, "As in the paper").figures + part(found, "Honest").figures:
        for panel in one.panels:
            assert sum(len(curve.y) for curve in panel.curves) <= 700


@pytest.mark.thorough
def test_figure_5_has_the_measured_current_and_five_methods(found: StudyResult) -> None:
    names = [curve.name for curve in figure(found, "fig-5").panels[0].curves]
    assert names == ["measured", "least squares", "ridge", "LASSO", "elastic net", "WLS"]


@pytest.mark.thorough
def test_table_2_is_least_squares_of_scikit_learn_on_eq_20(
    data: Dataset, found: StudyResult
) -> None:
    one = one_per_pose(recording_of(data, robot()).dwells, seed=0)
    parts = by_sample(one, seed=0)
    i = one["effort"][:, 1]
    R = np.column_stack([paper_functions(one["q"])[0], i * np.abs(i)])
    fitted = LinearRegression().fit(R[parts.train], i[parts.train])
    expected = np.sqrt(np.mean((fitted.predict(R[parts.test]) - i[parts.test]) ** 2))
    assert cell(table(found, "table-2"), "least squares", "J2") == pytest.approx(expected, rel=1e-8)


@pytest.mark.thorough
def test_by_sample_every_pose_is_on_both_sides_and_by_pose_none(data: Dataset) -> None:
    one = one_per_pose(recording_of(data, robot()).dwells, seed=0)
    sample, pose = by_sample(one, seed=0), by_pose(one, seed=0)
    dwell = one.series_index()
    assert set(dwell[sample.test]) <= set(dwell[sample.train])
    assert not set(dwell[pose.test]) & set(dwell[pose.train])


@pytest.mark.thorough
def test_friction_dealt_out_at_random_looks_as_good_by_sample_and_fails_by_pose(
    found: StudyResult,
) -> None:
    split = table(found, "table-split")
    held_out = {row[0]: cell(split, str(row[0]), "mean") for row in split.rows}
    as_printed = held_out["samples held out, as in the paper"]
    assert held_out["friction permuted among the poses, samples held out"] < 1.5 * as_printed
    assert held_out["whole poses held out"] > 5 * as_printed


@pytest.mark.thorough
def test_an_error_per_sample_is_never_below_the_noise_it_holds(found: StudyResult) -> None:
    four = table(found, "table-4")
    noise = np.array([cell(four, f"J{j}", "noise of a sample") for j in range(1, 7)])
    test = np.array([cell(four, f"J{j}", "test samples") for j in range(1, 7)])
    assert np.all(test > 0.9 * noise)


@pytest.mark.thorough
def test_one_dwell_of_every_pose_is_drawn_and_both_sides_occur(data: Dataset) -> None:
    drawn = one_per_pose(recording_of(data, robot()).dwells, seed=0).conditions
    assert len({c.pose for c in drawn}) == len(drawn) == 60
    assert {c.approach for c in drawn} == {-1, 1}


@pytest.mark.thorough
def test_every_dwell_is_judged_once_by_models_that_have_not_seen_its_pose(data: Dataset) -> None:
    asked = methods("gravity", "coulomb")
    protocol = HonestProtocol(
        recording_of(data, robot()), methods=asked, folds=3, hold_out_percent=None, seed=0
    )
    judged: list[int] = []
    for task in protocol.tasks()[:3]:
        _, train, test, _ = task.run.args  # type: ignore[attr-defined]
        seen = {group_of(c, "pose") for c in train.conditions}
        assert not seen & {group_of(c, "pose") for c in test.conditions}
        judged += dict.fromkeys(dwells_in(test).tolist())
    assert sorted(judged) == list(range(120))


@pytest.mark.thorough
@pytest.mark.parametrize("key", METHOD_KEYS)
def test_no_honest_prediction_depends_on_the_current_it_is_to_predict(
    key: str, data: Dataset
) -> None:
    dwells = recording_of(data, robot()).dwells
    train = dwells.select(lambda c: c.pose >= 20)
    test = dwells.select(lambda c: c.pose < 20)
    other = test.with_columns(effort=np.full_like(test["effort"], 3.0))
    (method,) = methods(key)
    tasks = [fit_tasks(method, train, one, robot())[0] for one in (test, other)]
    first, second = run_tasks(tasks, 1, "fits", silent)
    assert not first.failed
    assert np.isfinite(first.effort).all()
    assert np.array_equal(first.effort, second.effort)


@pytest.mark.thorough
def test_pose_only_methods_stay_at_the_friction_and_ours_goes_far_below(
    found: StudyResult,
) -> None:
    honest = table(found, "table-honest")
    gravity = cell(honest, "gravity by WLS, shared", "mean")
    network = cell(honest, "gravity + network of q2…q5", "mean")
    coulomb = cell(honest, "gravity + Fc·sign(approach)", "mean")
    ours = cell(honest, "ours: friction with memory", "mean")
    assert network == pytest.approx(gravity, rel=0.05)
    assert coulomb < gravity / 3
    assert ours < coulomb / 3


def test_the_band_of_both_approaches_is_the_friction_there_is() -> None:
    data = program(40, noise=1e-6)
    asked = {**SMALL, "protocols": ["honest"], "methods": ["gravity", "coulomb"]}
    sides = table(study("static-separation", **asked).run(data, robot()), "table-sides")
    band = [cell(sides, f"J{j}", "band") for j in range(1, 7)]
    assert band == pytest.approx(FRICTION, rel=1e-4)
    assert all(cell(sides, f"J{j}", "band: Fc·sign") < 1e-4 for j in range(1, 7))


@pytest.mark.thorough
def test_means_and_rows_are_found_again_after_a_split(data: Dataset) -> None:
    one = one_per_pose(recording_of(data, robot()).dwells, seed=0)
    parts = by_pose(one, seed=0)
    assert np.array_equal(one["effort"][rows_in(parts.training)], parts.training["effort"])


@pytest.mark.thorough
def test_progress_counts_every_fit_once(
    found: StudyResult, told: list[tuple[str, int, int]]
) -> None:
    total = told[0][2]
    assert [done for _, done, _ in told] == list(range(total + 1))


@pytest.mark.thorough
def test_equal_parameters_give_equal_numbers(data: Dataset, found: StudyResult) -> None:
    asked = {**SMALL, "protocols": ["paper"], "figures": False}
    again = study("static-separation", **asked).run(data, robot())
    assert table(again, "table-4") == table(found, "table-4")


def test_the_spec_names_the_study_with_parameters_it_accepts() -> None:
    (entry,) = hil.load(SPEC).spec.study
    asked = study(entry.study, **entry.parameters)
    assert (asked.layout, asked.epochs) == ([4, 20, 20, 10, 1], 1000)  # type: ignore[attr-defined]


@pytest.mark.thorough
def test_a_run_on_the_mock_leaves_both_protocols_behind(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(MOCK_SPEC, "utf-8")
    report = hil.run(hil.load(tmp_path / "spec.yaml"), runs=tmp_path / "runs")
    assert report.error is None
    (file,) = study_files(report.run)
    made = read_study(file)
    assert [one.title for one in made.parts] == ["The recording", "As in the paper", "Honest"]
    honest = table(made, "table-honest")
    coulomb = cell(honest, "gravity + Fc·sign(approach)", "mean")
    assert coulomb < cell(honest, "gravity by WLS, shared", "mean") / 2


# The static separation study on data and parameters that are not as they should be


QUICK: dict[str, Any] = {
    "protocols": ["honest"],
    "methods": ["gravity", "coulomb"],
    "folds": 2,
    "figures": False,
    "jobs": 1,
}
PAPER: dict[str, Any] = {
    "protocols": ["paper"],
    "layouts": [[4, 1]],
    "layout": [4, 1],
    "epochs": 1,
    "figures": False,
    "jobs": 1,
}


def studied(data: Dataset, **asked: Any) -> StudyResult:
    return study("static-separation", **{**QUICK, **asked}).run(data, robot())


def warned(found: StudyResult, words: str) -> bool:
    return any(words in warning for warning in found.warnings)


def keys(found: StudyResult) -> set[str]:
    return {table.key for part in found.parts for table in part.tables}


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(FitError, match="3 poses are too few"):
        studied(program(3))


def test_fewer_poses_than_folds_are_refused() -> None:
    with pytest.raises(FitError, match="9 folds are not possible with 6 pose"):
        studied(program(6), folds=9)


def test_poses_too_few_for_every_method_are_refused_with_the_reason() -> None:
    with pytest.raises(FitError, match=r"no method could be fitted.*too few"):
        studied(program(4), methods=["gravity"])


def test_a_paper_protocol_without_enough_poses_leaves_the_honest_one() -> None:
    asked = {**PAPER, "protocols": ["paper", "honest"], "methods": ["coulomb"]}
    found = studied(program(9, noise=1e-3), **asked)
    assert warned(found, "the paper protocol is omitted: 6 poses are too few")
    assert "table-honest" in keys(found)


def test_dwells_with_nan_currents_are_left_out_and_told() -> None:
    data = program(30)
    effort = np.array(data["effort"])
    effort[3 * SAMPLES + 4, 2] = np.nan
    found = studied(data.with_columns(effort=effort))
    assert warned(found, "1 dwells contain NaN or infinite positions or efforts and are omitted")
    assert np.isfinite([row[-1] for row in found.parts[1].tables[0].rows]).all()


def test_a_recording_of_nothing_but_nan_is_refused() -> None:
    data = program(10)
    with pytest.raises(FitError, match="0 poses are too few"):
        studied(data.with_columns(effort=np.full_like(data["effort"], np.nan)))


def test_dwells_of_fewer_than_ten_samples_are_used_and_told() -> None:
    data = program(30)
    short = rows_of(data, ~((data.series_index() == 5) & (np.arange(len(data)) % 3 == 0)))
    assert warned(studied(short), "1 of 60 dwells have fewer than 10 samples")


def test_dwells_that_never_settled_are_left_out_and_told() -> None:
    data = program(30)
    loose = tuple(replace(c, settled=i > 1) for i, c in enumerate(data.conditions))
    assert warned(studied(replace(data, conditions=loose)), "2 dwells that did not settle")


def test_a_joint_that_never_moved_is_named() -> None:
    data = program(30)
    q = np.array(data["q"])
    q[:, 5] = 0.3
    found = studied(data.with_columns(q=q))
    assert warned(found, f"{data.joint_names[5]} never moved")


def test_a_still_joint_that_gravity_turns_on_is_refused_with_its_name() -> None:
    data = program(30)
    q = np.array(data["q"])
    q[:, 1] = 0.3
    with pytest.raises(FitError, match=f"(?s){data.joint_names[1]} never moved"):
        studied(data.with_columns(q=q), methods=["ls"])


def test_torques_leave_out_the_paper_and_are_told_in_their_own_unit() -> None:
    data = replace(program(30), effort_kind="torque", drive_gains=None)
    found = studied(data, protocols=["paper", "honest"])
    assert warned(found, "the paper protocol is omitted: eq. 16 to 20 require motor currents")
    assert "N·m" in found.parts[1].tables[0].title


def test_torques_alone_cannot_follow_the_paper() -> None:
    data = replace(program(30), effort_kind="torque", drive_gains=None)
    with pytest.raises(FitError, match="require motor currents"):
        studied(data, protocols=["paper"])


def test_one_sided_approaches_leave_out_the_band() -> None:
    found = studied(program(40, approaches=(1,)), methods=["gravity"])
    assert warned(found, "no pose was approached from both directions")
    assert "table-sides" not in keys(found)


def test_a_method_that_needs_more_than_was_recorded_is_left_out_with_the_reason() -> None:
    found = studied(replace(program(30), arrivals=None))
    assert warned(found, "gravity + Fc·sign(approach) (static-coulomb) is omitted")
    assert [row[0] for row in found.parts[1].tables[0].rows][:1] == ["gravity by WLS, shared"]


def test_a_joint_the_robot_does_not_have_is_refused() -> None:
    with pytest.raises(FitError, match="joint is 7, but ur5 has 6"):
        studied(program(10), joint=7)


def test_data_of_another_robot_are_refused() -> None:
    with pytest.raises(FitError, match="recorded on a ur5"):
        study("static-separation", **QUICK).run(program(10), load_model("ur10"))


def test_a_share_of_poses_can_be_held_out_once_instead_of_folds() -> None:
    found = studied(program(30), hold_out_percent=20.0)
    assert "12 dwells of poses drawn at random are held out" in found.parts[1].text[0]


@pytest.mark.thorough
def test_the_paper_protocol_runs_without_the_honest_one() -> None:
    found = studied(program(40), **PAPER)
    assert [part.title for part in found.parts] == ["The recording", "As in the paper"]


def test_poses_of_different_loads_are_not_paired() -> None:
    conditions = program(4).conditions
    loaded = tuple(replace(c, load=int(c.approach > 0)) for c in conditions)
    assert len(pairs(conditions)) == 4
    assert pairs(loaded) == []


def test_noise_of_a_sample_is_the_scatter_within_dwells() -> None:
    dwells = recording_of(program(200, noise=0.02), robot()).dwells
    assert sample_noise(dwells) == pytest.approx(0.02, rel=0.05)
    assert sample_noise(one_per_pose(dwells, 0)) == pytest.approx(0.02, rel=0.05)


@pytest.mark.thorough
def test_results_of_processes_come_in_the_order_of_the_tasks() -> None:
    told: list[tuple[str, int, int]] = []
    tasks = [Task(partial(mul, 2, k), cost=k) for k in range(5)]
    found = run_tasks(tasks, 2, "doubling", lambda *progress: told.append(progress))
    assert found == run_tasks(tasks, 1, "doubling", silent) == [0, 2, 4, 6, 8]
    assert told[0] == ("doubling", 0, 5)
    assert told[-1] == ("doubling", 5, 5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("protocols", "paper"),
        ("protocols", ["published"]),
        ("layouts", []),
        ("layouts", [[5, 10, 1]]),
        ("layout", [4, 10, 2]),
        ("layout", "4-20-1"),
        ("first_layer", "relu"),
        ("epochs", 0),
        ("epochs", 1.5),
        ("alpha", 0),
        ("weights", "ones"),
        ("methods", ["hysterisis"]),
        ("methods", []),
        ("folds", 1),
        ("hold_out_percent", 100),
        ("joint", 0),
        ("figures", "no"),
        ("seed", -1),
        ("jobs", 0),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(SpecError, match=name):
        study("static-separation", **{name: value})
