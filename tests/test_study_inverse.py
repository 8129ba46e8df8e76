"""The study of inverse dynamics: who is fitted to what, what is judged, and what it says."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inverse_parts import SMALL, Toy, run_of, toys
from synthetic_motion import LOAD, nominal, plant

from hil.data.dataset import Dataset
from hil.data.parts import JUDGE, PART
from hil.data.splits import groups
from hil.errors import DataError, FitError
from hil.identify.model_file import json_bytes
from hil.study import inverse_fits
from hil.study.base import study
from hil.study.inverse_cases import Case, honest_case, paper_case, recorded
from hil.study.inverse_methods import ROW_KEYS, families
from hil.study.inverse_noise import white_noise_left
from hil.study.inverse_printed import PRINTED, PRINTED_AVERAGES
from hil.study.result import StudyResult, Table
from hil.study.soundness import faults_of

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "studies.md"


@pytest.fixture(autouse=True)
def _no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_fits, "unfitted", toys)
    monkeypatch.setattr(inverse_fits.plugins, "names", lambda group: _Every())
    monkeypatch.setattr(Toy, "fits", 0)


class _Every:
    def __contains__(self, name: object) -> bool:
        return True


def made(data: Dataset | None = None, **changed: Any) -> StudyResult:
    return study("inverse-dynamics", **{**SMALL, **changed}).run(data or run_of(), nominal())


def table(of: StudyResult, key: str) -> Table:
    return next(table for part in of.parts for table in part.tables if table.key == key)


def cell(of: Table, row: str, column: str) -> Any:
    return next(values for values in of.rows if values[0] == row)[of.columns.index(column)]


def case_of(make: Any = honest_case, seed: int = 0) -> Case:
    return make(recorded(run_of(), nominal(), 20.0, 50.0), seed)


def test_the_result_can_be_shown_and_survives_json() -> None:
    found = made()
    assert faults_of(found) == []
    again = StudyResult.from_dict(json.loads(json_bytes(found.to_dict())))
    assert table(again, "table-honest").rows == table(found, "table-honest").rows


def test_both_protocols_stand_side_by_side_and_are_labelled() -> None:
    labels = [part.protocol for part in made(methods=["wls"]).parts if part.protocol]
    assert labels == ["paper: samples split at random within trajectories", "honest"]


def test_the_page_about_studies_lists_the_tables_and_figures_there_are() -> None:
    section = PAGE.read_text("utf-8").split("### What a comparison shows")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `((?:table|fig)-.+?) \|", section, re.MULTILINE)
    listed = {key.strip("`") for row in rows for key in row.split(", ")}
    found = made(methods=["wls", "proposed", "rc-motion"])
    made_ = {one.key for part in found.parts for one in (*part.tables, *part.figures)}
    assert listed - {"fig-learning"} == made_


def test_a_leak_planted_among_the_judged_motions_is_caught() -> None:
    case = case_of()
    stolen = case.learn.take([0])
    copy = tuple(replace(c, source="elsewhere", id="copy") for c in stolen.conditions)
    later = replace(stolen, conditions=copy).with_columns(t=stolen["t"] + 99.0)
    leaky = replace(case, judge=Dataset.concatenate([case.judge, later]))
    with pytest.raises(DataError, match="also in the training data"):
        inverse_fits.fit_family("wls", ("wls",), leaky, nominal(), 0.01, 1.0)


def test_a_leak_through_a_load_is_caught() -> None:
    case = case_of()
    leaky = replace(case, loaded=recorded(run_of(), nominal(), 20.0, 50.0).loaded)
    with pytest.raises(DataError, match="trajectory group"):
        leaky.require_honest()


def test_rows_that_the_papers_draw_gives_away_cannot_be_judged() -> None:
    case = case_of(paper_case)
    with pytest.raises(DataError, match="judged that were learned from"):
        replace(case, rows=~case.rows).require_honest()


def test_everything_that_is_not_judged_is_handed_to_a_fit_and_nothing_else() -> None:
    case = case_of(seed=3)
    held, kept = set(groups(case.judge, "trajectory")), set(groups(case.learn, "trajectory"))
    assert len(held) == 1
    assert held | kept == set(groups(run_of(), "trajectory"))
    assert not held & kept
    assert {c.load for c in case.learn.conditions} == {0}


def test_the_papers_draw_keeps_motions_whole_and_judges_a_fifth_of_the_samples() -> None:
    case = case_of(paper_case)
    assert np.array_equal(np.diff(case.learn.offsets), np.full(4, 300))
    assert np.array_equal(case.rows, case.learn[PART] == JUDGE)
    assert np.mean(case.rows) == pytest.approx(0.2, abs=0.03)


def test_loads_are_those_motions_that_no_model_has_seen() -> None:
    case = case_of()
    assert case.loaded is not None
    assert groups(case.loaded, "trajectory") == groups(case.judge, "trajectory")
    assert {c.load for c in case.loaded.conditions} == {1}


def test_a_forgotten_load_costs_the_torque_of_that_load() -> None:
    data = run_of(noise_a=0.0)
    shown = table(made(data, methods=["wls"], protocols=["honest"]), "table-loads")
    case = honest_case(recorded(data, nominal(), 20.0, 50.0), 0)
    assert case.loaded is not None
    motion = [case.loaded[name] for name in ("q_f", "qd_f", "qdd_f")]
    carried = plant().with_payload(LOAD).inverse_dynamics(*motion) - plant().inverse_dynamics(
        *motion
    )
    expected = float(np.mean(np.sqrt(np.mean(carried**2, axis=0))))
    assert cell(shown, "Method 1: WLS", "2 kg unaware") == pytest.approx(expected, rel=0.02)
    aware = cell(shown, "Method 1: WLS", "2 kg aware")
    assert aware == pytest.approx(cell(shown, "Method 1: WLS", "no other load"), rel=0.05)


def test_corrections_share_the_model_of_their_seed() -> None:
    made(methods=["rc-paper", "rc-motion"], protocols=["honest"], seeds=2)
    assert Toy.fits == 2


def test_a_correction_is_judged_on_top_of_its_base() -> None:
    shown = table(made(methods=["proposed", "rc-motion"], protocols=["honest"]), "table-honest")
    base = cell(shown, "Proposed: DeLaN, Stribeck, hybrid", "mean")
    assert cell(shown, "Proposed with RC, no torque", "mean") == pytest.approx(base / 2)


def test_repeated_torque_stands_beside_what_sees_torque() -> None:
    names = [row[0] for row in table(made(protocols=["honest"]), "table-honest").rows]
    at = names.index("Proposed with RC, torque until 20 ms before")
    assert names[at + 1] == "the torque of 20 ms ago, repeated"
    assert "repeated" not in names[names.index("Proposed with RC, no torque") + 1]


def test_a_correction_that_breaks_down_costs_only_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(Toy, "fit_on", broken)
    told = made(protocols=["honest"])
    assert sum("ZeroDivisionError: of all things" in text for text in told.warnings) == 2
    assert "Proposed: DeLaN, Stribeck, hybrid" in str(table(told, "table-honest").rows)
    assert "RC" not in str(table(told, "table-honest").rows)


def test_what_is_not_installed_is_said_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_fits.plugins, "names", lambda group: ("rigid-wls", "residual"))
    told = made(protocols=["honest"])
    assert "Proposed with RC, no torque: lagrangian is not installed" in told.warnings
    assert "Proposed" not in str(table(told, "table-honest").rows[:2])


def test_without_other_loads_there_is_no_table_of_them() -> None:
    found = made(run_of(loaded=False), methods=["wls"], protocols=["honest"])
    assert "table-loads" not in {one.key for part in found.parts for one in part.tables}


def test_too_few_trajectories_of_the_bare_arm_are_refused() -> None:
    with pytest.raises(FitError, match="2 trajectories are too few"):
        made(run_of(2))


def test_white_noise_left_by_the_filter_is_estimated_from_what_it_removed() -> None:
    quiet, noisy = (
        recorded(run_of(3, loaded=False, noise_a=a), nominal(), 20.0, 50.0).bare.data
        for a in (0.0, 0.05)
    )
    case = honest_case(recorded(run_of(3, loaded=False), nominal(), 20.0, 50.0), 0)
    noise = {name: noisy[name] - quiet[name] for name in ("effort", "effort_f")}
    left = np.sqrt(np.mean(noise["effort_f"] ** 2))
    removed = np.sqrt(np.mean((noise["effort"] - noise["effort_f"]) ** 2))
    assert white_noise_left(np.array([removed]), case) == pytest.approx(left, rel=0.05)


def test_every_row_belongs_to_one_family() -> None:
    found = families(ROW_KEYS)
    assert sorted(key for keys in found.values() for key in keys) == sorted(ROW_KEYS)
    assert found["proposed"][0] == "proposed"
    assert {"rc-paper", "rc-history", "rc-motion", "rc-grouped"} < set(found["proposed"])


def test_the_printed_table_adds_up_once_the_stray_zeros_are_out() -> None:
    for key, row in PRINTED.items():
        assert np.mean(row) == pytest.approx(PRINTED_AVERAGES[key], abs=0.006)
