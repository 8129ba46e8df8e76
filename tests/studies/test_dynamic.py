"""The study of dynamic identification: what it shows, and that its honest part is honest."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression

import hil
from hil.core import json_document, plugins
from hil.core.errors import DataError, FitError
from hil.data.dataset import Dataset
from hil.data.filters import FilterSettings, prepare
from hil.data.splits import assert_disjoint, groups
from hil.dynamics import base_parameters, friction_terms, joint_columns
from hil.estimators.base import GROUP
from hil.studies import dynamic_methods
from hil.studies.base import study
from hil.studies.dynamic_methods import (
    REVERSAL_S,
    honest_parts,
    near_reversals,
    paper_parts,
    trajectories_of,
)
from hil.studies.dynamic_tables import AVERAGES, TABLE_II
from hil.studies.result import StudyResult, Table, faults_of
from tests.support.paths import DOCS, EXPERIMENTS
from tests.support.study_parts import assert_figures_survive_json
from tests.support.synthetic_motion import SIGN_WIDTH, moving, nominal, raw

SMALL: dict[str, Any] = {
    "cutoff_hz": 20.0,
    "rate_hz": 50.0,
    "splits": 2,
    "jobs": 1,
    "methods": ["ols", "wls"],
}
SPECS = sorted((EXPERIMENTS).glob("*_dynamic_identification.yaml"))


@pytest.fixture(scope="module")
def data() -> Dataset:
    return raw(moving(1, 2, 3, 4, 5, 6, noise_a=0.05))


@pytest.fixture(scope="module")
def found(data: Dataset) -> StudyResult:
    return study("dynamic-identification", **SMALL).run(data, nominal())


def table(of: StudyResult, key: str) -> Table:
    return next(table for part in of.parts for table in part.tables if table.key == key)


def cell(of: Table, row: str, column: str) -> Any:
    return next(values for values in of.rows if values[0] == row)[of.columns.index(column)]


@pytest.mark.thorough
def test_the_result_can_be_shown_and_survives_json(found: StudyResult) -> None:
    assert faults_of(found) == []
    again = StudyResult.from_dict(json.loads(json_document(found.to_dict())))
    assert table(again, "table-honest").rows == table(found, "table-honest").rows
    assert_figures_survive_json(found)


def test_both_protocols_stand_side_by_side_and_are_labelled(found: StudyResult) -> None:
    labels = [part.protocol for part in found.parts if part.protocol]
    assert labels == ["paper: samples split at random within trajectories", "honest"]


def test_the_page_about_studies_lists_the_tables_and_figures_there_are(found: StudyResult) -> None:
    page = (DOCS / "reference" / "studies.md").read_text("utf-8")
    section = page.split("### What it shows")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `((?:table|fig)-.+?) \|", section, re.M)
    listed = {key.strip("`") for row in rows for key in row.split(", ")}
    made = {one.key for part in found.parts for one in (*part.tables, *part.figures)}
    assert listed == made


def test_honest_least_squares_is_that_of_scikit_learn(data: Dataset) -> None:
    asked = SMALL | {"splits": 1, "protocols": ["honest"], "methods": ["ols"], "seed": 4}
    shown = table(study("dynamic-identification", **asked).run(data, nominal()), "table-honest")
    cut = dict.fromkeys(("velocity", "acceleration", "effort"), 20.0)
    filtered = prepare(data, FilterSettings.model_validate({"unit": "hz", **cut}))
    test = honest_parts(trajectories_of(data, nominal(), 20.0, 50.0), 4)
    base = base_parameters(nominal(), rotor=True)

    def rows(part: Dataset) -> tuple[np.ndarray, np.ndarray]:
        motion = [part[name] for name in ("q_f", "qd_f", "qdd_f")]
        W = base.reduce(nominal().regressor(*motion))
        friction = joint_columns(friction_terms(motion[1], SIGN_WIDTH))
        return np.hstack([W, friction]), part["effort_f"]

    def of(part: Dataset) -> Dataset:
        return filtered.select(lambda c: c.id in {x.id for x in part.conditions})

    gains = data.drive_gains
    assert gains is not None
    X, current = rows(of(test.train))
    stride = np.arange(len(current)) % 600 % 2 == 0  # 50 of 100 samples a second
    chosen = np.repeat(stride, 6)
    fit = LinearRegression(fit_intercept=False)
    fit.fit(X[chosen], (current[stride] * gains).ravel())
    X, current = rows(of(test.test))
    error = fit.predict(X).reshape(-1, 6) - current * gains
    for j in range(6):
        expected = np.sqrt(np.mean(error[:, j] ** 2))
        assert cell(shown, "least squares", f"J{j + 1}") == pytest.approx(expected, rel=1e-6)


def test_whole_trajectories_are_dealt_out_7_2_3() -> None:
    of = trajectories_of(raw(moving(*range(1, 13), samples=80)), nominal(), 20.0, 50.0)
    parts = honest_parts(of, 0)
    counts = [len(groups(p, "trajectory")) for p in (parts.train, parts.validation, parts.test)]
    assert counts == [7, 2, 3]
    for one, other in pairwise((parts.train, parts.validation, parts.test)):
        assert_disjoint(one, other)


def test_the_papers_split_has_samples_of_every_trajectory_on_all_sides(data: Dataset) -> None:
    parts = paper_parts(trajectories_of(data, nominal(), 20.0, 50.0), 0)
    for part in (parts.train, parts.validation, parts.test):
        assert np.all(np.diff(part.offsets) > 0)
    assert len(parts.train) / 1800 == pytest.approx(0.6, abs=0.05)


def test_reversals_are_where_the_velocity_changes_its_sign() -> None:
    t = np.arange(0.0, 4.0, 0.001)
    qd = np.stack([np.sin(np.pi * (t - 0.3)), np.full_like(t, 1.0)], axis=1)
    marked = near_reversals(t, qd)
    turns = 0.3 + np.arange(4)
    expected = np.min(np.abs(t[:, None] - turns), axis=1) <= REVERSAL_S
    assert np.count_nonzero(marked[:, 0] != expected) <= 8  # one sample at either end
    assert not marked[:, 1].any()


def test_memory_is_not_asked_of_samples_torn_from_their_path(data: Dataset) -> None:
    asked = SMALL | {"methods": ["ols", "hysteresis"], "protocols": ["paper"], "splits": 1}
    shown = table(study("dynamic-identification", **asked).run(data, nominal()), "table-paper")
    assert [row[0] for row in shown.rows if "printed" not in str(row[0])] == ["least squares"]


def test_what_is_not_installed_is_said_and_left_out(data: Dataset, monkeypatch: Any) -> None:
    names = [name for name in plugins.names(GROUP) if name != "rigid-lmi"]
    monkeypatch.setattr(plugins, "names", lambda group: names)
    asked = SMALL | {"methods": ["ols", "lmi"], "splits": 1, "protocols": ["honest"]}
    told = study("dynamic-identification", **asked).run(data, nominal())
    assert "Method 2: OLS, physical constraints: rigid-lmi is not installed" in told.warnings
    assert "Method 2" not in str(table(told, "table-honest").rows)


def test_a_method_that_breaks_down_costs_only_itself(data: Dataset, monkeypatch: Any) -> None:
    fitted = dynamic_methods.estimator

    def broken(name: str, **params: Any) -> Any:
        if params.get("weighted", True):
            raise ZeroDivisionError("of all things")
        return fitted(name, **params)

    monkeypatch.setattr(dynamic_methods, "estimator", broken)
    told = study("dynamic-identification", **SMALL).run(data, nominal())
    assert "ZeroDivisionError: of all things" in told.warnings[-1]
    assert [row[0] for row in table(told, "table-fits").rows] == ["least squares"]


def test_it_says_what_is_not_as_in_the_paper(found: StudyResult) -> None:
    assert found.warnings[:2] == (
        "6 trajectories; the paper has twelve",
        "recorded at 100 Hz; the paper at 1000 Hz",
    )


def test_a_cut_off_too_high_for_the_recording_is_refused_with_the_remedy(data: Dataset) -> None:
    asked = SMALL | {"cutoff_hz": 50.0}
    with pytest.raises(DataError, match="too high") as error:
        study("dynamic-identification", **asked).run(data, nominal())
    assert error.value.hint == "choose at most 20 Hz, or up to 40 Hz with a higher rate_hz"


def test_too_few_trajectories_are_refused() -> None:
    with pytest.raises(FitError, match="2 trajectories are too few"):
        study("dynamic-identification", **SMALL).run(raw(moving(1, 2)), nominal())


def test_the_printed_table_adds_up_once_the_stray_zeros_are_out() -> None:
    for key, row in TABLE_II.items():
        assert np.mean(row) == pytest.approx(AVERAGES[key], abs=0.006)


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_shipped_specs_name_the_study_with_parameters_it_accepts(path: Path) -> None:
    (entry,) = hil.load(path, EXPERIMENTS / "stations" / "mock_1khz.yaml").spec.study
    study(entry.study, **entry.parameters)


def test_there_is_a_spec_for_each_of_the_mocks_two_arms() -> None:
    assert [path.stem.split("_")[0] for path in SPECS] == ["lab6", "ur5"]
