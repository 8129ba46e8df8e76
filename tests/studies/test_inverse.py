"""The study of inverse dynamics: who is fitted to what, what is judged, and what it says."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from hil.core import json_document
from hil.core.errors import DataError, FitError
from hil.data.dataset import Dataset, rows_of
from hil.data.filters import FilterSettings
from hil.estimators.base import estimator
from hil.studies import inverse_dynamics, inverse_fits, inverse_methods
from hil.studies.base import Ended, study
from hil.studies.inverse_cases import honest_case, recorded
from hil.studies.inverse_methods import ROW_KEYS, ROWS, USUAL_EPOCHS, families, unfitted
from hil.studies.inverse_tables import PRINTED, PRINTED_AVERAGES
from hil.studies.result import StudyResult, Table, faults_of
from tests.support.inverse_parts import SMALL, Toy, run_of, toys
from tests.support.paths import DOCS
from tests.support.study_parts import assert_figures_survive_json
from tests.support.synthetic_motion import LOAD, nominal, plant

PAGE = DOCS / "reference" / "studies.md"


@pytest.fixture(autouse=True)
def _no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_fits, "unfitted", toys)
    monkeypatch.setattr(inverse_methods.plugins, "names", lambda group: _Every())
    monkeypatch.setattr(Toy, "fits", 0)


class _Every:
    def __contains__(self, name: object) -> bool:
        return True


def thinned(data: Dataset, number: int) -> Dataset:
    """Every tenth sample of a trajectory is lost: its mean rate is a tenth lower."""
    place = np.arange(len(data)) - data.offsets[:-1][data.series_index()]
    return rows_of(data, (data.series_index() != number) | (place % 10 != 5))


def made(data: Dataset | None = None, **changed: Any) -> StudyResult:
    return study("inverse-dynamics", **{**SMALL, **changed}).run(data or run_of(), nominal())


def table(of: StudyResult, key: str) -> Table:
    return next(table for part in of.parts for table in part.tables if table.key == key)


def cell(of: Table, row: str, column: str) -> Any:
    return next(values for values in of.rows if values[0] == row)[of.columns.index(column)]


@pytest.mark.thorough
def test_the_result_can_be_shown_and_survives_json() -> None:
    found = made()
    assert faults_of(found) == []
    again = StudyResult.from_dict(json.loads(json_document(found.to_dict())))
    assert table(again, "table-honest").rows == table(found, "table-honest").rows
    assert_figures_survive_json(found)


def test_both_protocols_stand_side_by_side_and_are_labelled() -> None:
    labels = [part.protocol for part in made(methods=["wls"]).parts if part.protocol]
    assert labels == ["paper: samples split at random within trajectories", "honest"]


@pytest.mark.thorough
def test_the_page_about_studies_lists_the_tables_and_figures_there_are() -> None:
    section = PAGE.read_text("utf-8").split("### What a comparison shows")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `((?:table|fig)-.+?) \|", section, re.MULTILINE)
    listed = {key.strip("`") for row in rows for key in row.split(", ")}
    found = made(methods=["wls", "proposed", "rc-motion"])
    made_ = {one.key for part in found.parts for one in (*part.tables, *part.figures)}
    assert listed - {"fig-learning"} == made_


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


def test_every_fit_is_named_by_its_rows_protocol_and_seed() -> None:
    heard = []

    class Listening:
        def __call__(self, *_: object) -> None:
            pass

        def ended(self, ended: Ended) -> None:
            heard.append(ended.name)

    asked = SMALL | {"methods": ["wls", "proposed", "rc-motion"], "protocols": ["honest"]}
    study("inverse-dynamics", **asked, seed=5).run(run_of(), nominal(), Listening())
    assert heard == ["rigid-wls (wls), honest, seed 5",
                     "lagrangian (proposed, rc-motion), honest, seed 5"]  # fmt: skip


def test_corrections_share_the_model_of_their_seed() -> None:
    made(methods=["rc-paper", "rc-motion"], protocols=["honest"], seeds=2)
    assert Toy.fits == 2


def test_a_correction_is_judged_on_top_of_its_base() -> None:
    shown = table(made(methods=["proposed", "rc-motion"], protocols=["honest"]), "table-honest")
    base = cell(shown, "Proposed: DeLaN, Stribeck, hybrid", "mean")
    assert cell(shown, "Proposed with RC, no torque", "mean") == pytest.approx(base / 2)


def test_what_a_correction_decided_about_itself_is_told_in_torque() -> None:
    parts = made(methods=["wls", "proposed", "rc-motion"]).parts
    for part, rows in zip(parts, ("on samples drawn", "on trajectories"), strict=False):
        (shown,) = [one for one in part.tables if one.key.endswith("-decided")]
        assert rows in shown.note
        (row,) = shown.rows
        assert row[:2] == ("Proposed with RC, no torque", 1)
        gain = run_of().drive_gains
        assert row[2] == f"{0.4 * gain[0]:.3g} → {0.2 * gain[0]:.3g} (-50.0 %)"
        assert row[3] == f"dropped: {0.4 * gain[1]:.3g} → {0.2 * gain[1]:.3g} (-50.0 %)"


def test_settings_as_printed_are_an_optional_row_for_as_many_epochs_as_the_others() -> None:
    assert "proposed-literal" not in study("inverse-dynamics").get_params()["methods"]
    rows = {key: unfitted(ROWS[key], 0, 0.01, FilterSettings(), 1.0).get_params()
            for key in ("proposed", "proposed-literal")}  # fmt: skip
    assert rows["proposed-literal"]["protocol"] == "paper"
    assert rows["proposed-literal"]["training"] == {"epochs": USUAL_EPOCHS["lagrangian"]}
    found = made(methods=["proposed", "proposed-literal"], protocols=["paper"])
    assert "Proposed, settings as printed" in str(table(found, "table-paper").rows)


def test_what_the_filter_takes_out_is_not_said_to_be_noise_alone() -> None:
    found = made(methods=["wls"], protocols=["honest"])
    assert "signal above its cut-off" in table(found, "table-honest").note
    assert "signal above its cut-off" in table(found, "table-honest-raw").note


def test_repeated_torque_stands_beside_what_sees_torque() -> None:
    methods = ["proposed", "rc-paper", "rc-history", "rc-motion"]
    found = made(methods=methods, protocols=["honest"])
    names = [row[0] for row in table(found, "table-honest").rows]
    at = names.index("Proposed with RC, torque history until 20 ms before")
    assert names[at + 1] == "the torque of 20 ms ago, repeated"
    at = names.index(ROWS["rc-paper"].words)
    assert names[at + 1] == "the torque of 10 ms ago, repeated"
    assert "repeated" not in names[names.index("Proposed with RC, no torque") + 1]


def test_a_correction_that_breaks_down_costs_only_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(Toy, "fit_on", broken)
    told = made(protocols=["honest"])
    (note,) = [text for text in told.warnings if "ZeroDivisionError: of all things" in text]
    assert all(f"{ROWS[key].words}" in note for key in ("rc-history", "rc-motion"))
    assert "Proposed: DeLaN, Stribeck, hybrid" in str(table(told, "table-honest").rows)
    assert "RC" not in str(table(told, "table-honest").rows)


def test_a_reason_is_told_once_with_every_row_and_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise FitError("no torch")

    monkeypatch.setattr(Toy, "fit", broken)
    told = made(methods=["wls", "delan", "proposed"])
    (note,) = [text for text in told.warnings if "no torch" in text]
    assert note == (
        "Method 4: DeLaN (lagrangian), paper and honest; Proposed: DeLaN, Stribeck, hybrid "
        "(lagrangian), paper and honest: left out, no torch"
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fails", "told"),
    [("fit", "failed"), ("fit_on", "without rc-motion, which failed"), ("restore", "")],
)
def test_a_fit_that_failed_is_told_as_such(
    monkeypatch: pytest.MonkeyPatch, fails: str, told: str
) -> None:
    class Heard:
        found: tuple[Ended, ...] = ()

        def __call__(self, what: str, done: int, total: int) -> None:
            """Not of interest."""

        def ended(self, ended: Ended) -> None:
            self.found += (ended,)

    def broken(*_: object) -> None:
        raise FitError("no torch")

    monkeypatch.setattr(Toy, fails, broken)
    heard, wanted = Heard(), {"methods": ["wls", "proposed", "rc-motion"], "protocols": ["honest"]}
    study("inverse-dynamics", **{**SMALL, **wanted}).run(run_of(), nominal(), heard)
    failed = {one.name.partition(" ")[0]: one.failed for one in heard.found}
    assert failed == {"rigid-wls": "", "lagrangian": told}


@pytest.mark.thorough
def test_samples_lost_in_one_trajectory_cost_no_study() -> None:
    data = run_of(loaded=False)
    for lost in range(4):
        found = made(thinned(data, lost), methods=["wls"], cutoff_hz=15.0)
        assert faults_of(found) == []


def test_nothing_can_fail_any_more_after_the_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(case: object) -> None:
        raise DataError("of all things")

    monkeypatch.setattr(inverse_fits.Seen, "of", broken)
    monkeypatch.setattr(inverse_dynamics, "run_tasks", lambda *_: pytest.fail("it was fitted"))
    with pytest.raises(DataError, match="of all things"):
        made(methods=["wls"])


def test_what_is_not_installed_is_said_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_methods.plugins, "names", lambda group: ("rigid-wls", "residual"))
    told = made(protocols=["honest"])
    assert "Proposed with RC, no torque: lagrangian is not installed" in told.warnings
    assert "Proposed" not in str(table(told, "table-honest").rows[:2])


def test_without_other_loads_there_is_no_table_of_them() -> None:
    found = made(run_of(loaded=False), methods=["wls"], protocols=["honest"])
    assert "table-loads" not in {one.key for part in found.parts for one in part.tables}


def test_too_few_trajectories_of_the_bare_arm_are_refused() -> None:
    with pytest.raises(FitError, match="2 trajectories are too few"):
        made(run_of(2))


def test_every_row_belongs_to_one_family() -> None:
    found = families(ROW_KEYS)
    assert sorted(key for keys in found.values() for key in keys) == sorted(ROW_KEYS)
    assert found["proposed"][0] == "proposed"
    assert found["ours"] == ("ours", "ours-residual")
    assert {"rc-paper", "rc-history", "rc-motion", "rc-grouped"} < set(found["proposed"])


def test_the_printed_table_adds_up_once_the_stray_zeros_are_out() -> None:
    for key, row in PRINTED.items():
        assert np.mean(row) == pytest.approx(PRINTED_AVERAGES[key], abs=0.006)


@pytest.mark.thorough
@pytest.mark.parametrize("key", [key for key in ROW_KEYS if ROWS[key].learns])
def test_networks_are_trained_as_long_as_usual_unless_told(key: str) -> None:
    usual = estimator(ROWS[key].estimator, **ROWS[key].params).get_params()
    whole, tenth = (unfitted(ROWS[key], 7, 0.01, FilterSettings(), e) for e in (1.0, 0.1))
    assert whole.get_params()["training"] == usual["training"]
    assert tenth.get_params()["training"]["epochs"] == USUAL_EPOCHS[ROWS[key].estimator] // 10
    assert whole.get_params()["seed"] == 7


def test_all_see_the_motion_through_the_same_filter_and_smooth_sign() -> None:
    filters = FilterSettings.model_validate({"unit": "hz", "velocity": 21.0})
    for row in ROWS.values():
        params = unfitted(row, 0, 0.02, filters, 1.0).get_params()
        assert params["filters"] == filters
        assert params.get("sign_width", 0.02) == 0.02
