"""The study of inverse dynamics: who is fitted to what, what is judged, and what it says."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.core import json_document
from hil.core.errors import DataError, FitError
from hil.data.dataset import Dataset, rows_of
from hil.data.filters import FilterSettings
from hil.data.prediction import Prediction
from hil.data.splits import PART, TEST, groups
from hil.estimators.base import estimator
from hil.estimators.rigid_linear import RigidWls
from hil.studies import inverse_dynamics, inverse_fits, inverse_methods
from hil.studies.base import Ended, study
from hil.studies.inverse_cases import (
    Case,
    Held,
    honest_case,
    paper_case,
    persistence_of,
    recorded,
    white_noise_left,
)
from hil.studies.inverse_fits import Found, Judged, Seen, Shown, apart, judged
from hil.studies.inverse_methods import ROW_KEYS, ROWS, USUAL_EPOCHS, families, unfitted
from hil.studies.inverse_tables import PRINTED, PRINTED_AVERAGES, TEXTS, TITLES, summary
from hil.studies.result import StudyResult, Table, faults_of
from tests.support.inverse_parts import SMALL, Toy, run_of, toys
from tests.support.paths import DOCS
from tests.support.study_parts import assert_figures_survive_json
from tests.support.synthetic_motion import LOAD, nominal, plant

PAGE = DOCS / "reference" / "studies.md"


@pytest.fixture
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


@pytest.mark.usefixtures("_no_networks")
@pytest.mark.thorough
def test_the_result_can_be_shown_and_survives_json() -> None:
    found = made()
    assert faults_of(found) == []
    again = StudyResult.from_dict(json.loads(json_document(found.to_dict())))
    assert table(again, "table-honest").rows == table(found, "table-honest").rows
    assert_figures_survive_json(found)


@pytest.mark.usefixtures("_no_networks")
def test_both_protocols_stand_side_by_side_and_are_labelled() -> None:
    labels = [part.protocol for part in made(methods=["wls"]).parts if part.protocol]
    assert labels == ["paper: samples split at random within trajectories", "honest"]


@pytest.mark.usefixtures("_no_networks")
@pytest.mark.thorough
def test_the_page_about_studies_lists_the_tables_and_figures_there_are() -> None:
    section = PAGE.read_text("utf-8").split("### What a comparison shows")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `((?:table|fig)-.+?) \|", section, re.MULTILINE)
    listed = {key.strip("`") for row in rows for key in row.split(", ")}
    found = made(methods=["wls", "proposed", "rc-motion"])
    made_ = {one.key for part in found.parts for one in (*part.tables, *part.figures)}
    assert listed - {"fig-learning"} == made_


@pytest.mark.usefixtures("_no_networks")
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


@pytest.mark.usefixtures("_no_networks")
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


@pytest.mark.usefixtures("_no_networks")
def test_corrections_share_the_model_of_their_seed() -> None:
    made(methods=["rc-paper", "rc-motion"], protocols=["honest"], seeds=2)
    assert Toy.fits == 2


@pytest.mark.usefixtures("_no_networks")
def test_a_correction_is_judged_on_top_of_its_base() -> None:
    shown = table(made(methods=["proposed", "rc-motion"], protocols=["honest"]), "table-honest")
    base = cell(shown, "Proposed: DeLaN, Stribeck, hybrid", "mean")
    assert cell(shown, "Proposed with RC, no torque", "mean") == pytest.approx(base / 2)


@pytest.mark.usefixtures("_no_networks")
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


@pytest.mark.usefixtures("_no_networks")
def test_settings_as_printed_are_an_optional_row_for_as_many_epochs_as_the_others() -> None:
    assert "proposed-literal" not in study("inverse-dynamics").get_params()["methods"]
    rows = {key: unfitted(ROWS[key], 0, 0.01, FilterSettings(), 1.0).get_params()
            for key in ("proposed", "proposed-literal")}  # fmt: skip
    assert rows["proposed-literal"]["protocol"] == "paper"
    assert rows["proposed-literal"]["training"] == {"epochs": USUAL_EPOCHS["lagrangian"]}
    found = made(methods=["proposed", "proposed-literal"], protocols=["paper"])
    assert "Proposed, settings as printed" in str(table(found, "table-paper").rows)


@pytest.mark.usefixtures("_no_networks")
def test_what_the_filter_takes_out_is_not_said_to_be_noise_alone() -> None:
    found = made(methods=["wls"], protocols=["honest"])
    assert "signal above its cut-off" in table(found, "table-honest").note
    assert "signal above its cut-off" in table(found, "table-honest-raw").note


@pytest.mark.usefixtures("_no_networks")
def test_repeated_torque_stands_beside_what_sees_torque() -> None:
    methods = ["proposed", "rc-paper", "rc-history", "rc-motion"]
    found = made(methods=methods, protocols=["honest"])
    names = [row[0] for row in table(found, "table-honest").rows]
    at = names.index("Proposed with RC, torque history at least 20 ms old")
    assert names[at + 1] == "the torque of 20 ms ago, repeated"
    at = names.index(ROWS["rc-paper"].words)
    assert names[at + 1] == "the torque of 10 ms ago, repeated"
    assert "repeated" not in names[names.index("Proposed with RC, no torque") + 1]


@pytest.mark.usefixtures("_no_networks")
def test_a_correction_that_breaks_down_costs_only_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(Toy, "fit_on", broken)
    told = made(protocols=["honest"])
    (note,) = [text for text in told.warnings if "ZeroDivisionError: of all things" in text]
    assert all(f"{ROWS[key].words}" in note for key in ("rc-history", "rc-motion"))
    assert "Proposed: DeLaN, Stribeck, hybrid" in str(table(told, "table-honest").rows)
    assert "RC" not in str(table(told, "table-honest").rows)


@pytest.mark.usefixtures("_no_networks")
def test_a_reason_is_told_once_with_every_row_and_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise FitError("no torch")

    monkeypatch.setattr(Toy, "fit", broken)
    told = made(methods=["wls", "delan", "proposed"])
    (note,) = [text for text in told.warnings if "no torch" in text]
    assert note == (
        "Method 4: DeLaN (lagrangian), paper and honest; Proposed: DeLaN, Stribeck, hybrid "
        "(lagrangian), paper and honest: omitted, no torch"
    )


@pytest.mark.usefixtures("_no_networks")
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


@pytest.mark.usefixtures("_no_networks")
@pytest.mark.thorough
def test_samples_lost_in_one_trajectory_cost_no_study() -> None:
    data = run_of(loaded=False)
    for lost in range(4):
        found = made(thinned(data, lost), methods=["wls"], cutoff_hz=15.0)
        assert faults_of(found) == []


@pytest.mark.usefixtures("_no_networks")
def test_nothing_can_fail_any_more_after_the_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(case: object) -> None:
        raise DataError("of all things")

    monkeypatch.setattr(inverse_fits.Seen, "of", broken)
    monkeypatch.setattr(inverse_dynamics, "run_tasks", lambda *_: pytest.fail("it was fitted"))
    with pytest.raises(DataError, match="of all things"):
        made(methods=["wls"])


@pytest.mark.usefixtures("_no_networks")
def test_what_is_not_installed_is_said_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_methods.plugins, "names", lambda group: ("rigid-wls", "residual"))
    told = made(protocols=["honest"])
    assert "Proposed with RC, no torque: lagrangian is not installed" in told.warnings
    assert "Proposed" not in str(table(told, "table-honest").rows[:2])


@pytest.mark.usefixtures("_no_networks")
def test_without_other_loads_there_is_no_table_of_them() -> None:
    found = made(run_of(loaded=False), methods=["wls"], protocols=["honest"])
    assert "table-loads" not in {one.key for part in found.parts for one in part.tables}


@pytest.mark.usefixtures("_no_networks")
def test_too_few_trajectories_of_the_bare_arm_are_refused() -> None:
    with pytest.raises(FitError, match="2 trajectories are too few"):
        made(run_of(2))


@pytest.mark.usefixtures("_no_networks")
def test_every_row_belongs_to_one_family() -> None:
    found = families(ROW_KEYS)
    assert sorted(key for keys in found.values() for key in keys) == sorted(ROW_KEYS)
    assert found["proposed"][0] == "proposed"
    assert found["ours"] == ("ours", "ours-residual")
    assert {"rc-paper", "rc-history", "rc-motion", "rc-grouped"} < set(found["proposed"])


@pytest.mark.usefixtures("_no_networks")
def test_the_printed_table_adds_up_once_the_stray_zeros_are_out() -> None:
    for key, row in PRINTED.items():
        assert np.mean(row) == pytest.approx(PRINTED_AVERAGES[key], abs=0.006)


@pytest.mark.usefixtures("_no_networks")
@pytest.mark.thorough
@pytest.mark.parametrize("key", [key for key in ROW_KEYS if ROWS[key].learns])
def test_networks_are_trained_as_long_as_usual_unless_told(key: str) -> None:
    usual = estimator(ROWS[key].estimator, **ROWS[key].params).get_params()
    whole, tenth = (unfitted(ROWS[key], 7, 0.01, FilterSettings(), e) for e in (1.0, 0.1))
    assert whole.get_params()["training"] == usual["training"]
    assert tenth.get_params()["training"]["epochs"] == USUAL_EPOCHS[ROWS[key].estimator] // 10
    assert whole.get_params()["seed"] == 7


@pytest.mark.usefixtures("_no_networks")
def test_all_see_the_motion_through_the_same_filter_and_smooth_sign() -> None:
    filters = FilterSettings.model_validate({"unit": "hz", "velocity": 21.0})
    for row in ROWS.values():
        params = unfitted(row, 0, 0.02, filters, 1.0).get_params()
        assert params["filters"] == filters
        assert params.get("sign_width", 0.02) == 0.02


# What the study of inverse dynamics fits to and judges on: whole motions apart, leaks refused


def case_of(make: Any = honest_case, seed: int = 0) -> Case:
    return make(recorded(run_of(), nominal(), 20.0, 50.0), seed)


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
    with pytest.raises(DataError, match="test rows are among the training rows"):
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
    assert np.array_equal(case.rows, case.learn[PART] == TEST)
    assert np.mean(case.rows) == pytest.approx(0.2, abs=0.03)


def test_loads_are_those_motions_that_no_model_has_seen() -> None:
    case = case_of()
    assert case.loaded is not None
    assert groups(case.loaded, "trajectory") == groups(case.judge, "trajectory")
    assert {c.load for c in case.loaded.conditions} == {1}


class WarmingUp(RigidWls):
    """Least squares that is far off for the first samples of a motion, and says so."""

    def predict(self, dataset: Dataset) -> Prediction:
        told = super().predict(dataset)
        cold = np.isin(np.arange(len(dataset)), dataset.offsets[:-1, None] + np.arange(50))
        effort = told.effort + 1e3 * cold[:, None]
        return replace(told, effort=effort, valid=told.valid & ~cold[:, None])


def test_what_a_model_does_not_vouch_for_is_not_judged_under_a_load_either() -> None:
    case = case_of()
    found = judged(WarmingUp(filters=case.filters).fit(case.learn, nominal()), case, 0.0)
    assert found.known == pytest.approx(5 / 6)
    assert np.all(found.filtered < 1.0)
    assert np.all(found.aware[1] < 1.0)


def test_how_old_repeated_torque_is_depends_on_the_rate() -> None:
    held = persistence_of(case_of(), 0.001)
    assert held.age_s == pytest.approx(0.01)
    torque = case_of().judge["effort_f"] * case_of().scale
    expected = np.sqrt(np.mean(np.diff(torque, axis=0) ** 2, axis=0))
    assert held.error == pytest.approx(expected)


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


def test_noise_is_not_told_from_signal_where_the_filter_leaves_little_beside_it() -> None:
    case = honest_case(recorded(run_of(), nominal(), 30.0, 100.0), 0)  # of 50 Hz
    assert np.all(np.isnan(white_noise_left(np.ones(6), case)))


@pytest.mark.parametrize(
    ("rate_hz", "told", "hint", "most"),
    [
        (
            50.0,
            " and downsampled by rate_hz to 50 Hz",
            "20 Hz, or up to 40 Hz with a higher rate_hz",
            20.0,
        ),
        (100.0, "", "40 Hz", 40.0),
    ],
)
def test_a_cut_off_above_what_the_data_allow_is_refused_as_the_parameter_it_is(
    rate_hz: float, told: str, hint: str, most: float
) -> None:
    with pytest.raises(DataError) as caught:
        recorded(run_of(), nominal(), 900.0, rate_hz)
    told = f"cutoff_hz is 900 Hz: too high for data recorded at 100 Hz{told}"
    assert caught.value.message == told
    assert caught.value.hint == f"choose at most {hint}"
    recorded(run_of(), nominal(), most, rate_hz)


# Ranks of the study of inverse dynamics: only what seeds tell apart is put in order


NAN = np.full(2, np.nan)


def erring(error: float) -> Judged:
    return Judged(np.full(2, error), NAN, NAN, NAN, NAN, shown=Shown(np.zeros((1, 2))))


def found(**errors: tuple[float, ...]) -> Found:
    seeds = len(next(iter(errors.values())))
    held = {0.001: Held(0.004, np.full(2, 0.1)), 0.02: Held(0.024, np.full(2, 0.9))}
    one = np.zeros(1), np.zeros((1, 2))
    seen = Seen(*one, *one[1:] * 2, np.full(2, 0.5), np.full(2, 0.2), held, 125.0)
    scores = {name.replace("_", "-"): [erring(e) for e in told] for name, told in errors.items()}
    return Found("honest", scores, {}, [seen] * seeds, {})


def told(**errors: tuple[float, ...]) -> str:
    return "\n".join(summary([found(**errors)]))


def test_a_common_spread_does_not_hide_a_steady_difference() -> None:
    assert apart(found(a=(1.0, 2.0, 3.0), b=(1.1, 2.11, 3.1)), "a", "b")


def test_a_difference_within_two_seed_sigma_is_none() -> None:
    assert not apart(found(a=(1.0, 1.3, 1.6), b=(1.2, 1.2, 1.8)), "a", "b")


def test_fewer_than_three_seeds_rank_nothing() -> None:
    assert not apart(found(a=(1.0,), b=(9.0,)), "a", "b")
    assert not apart(found(a=(1.0, 1.1), b=(9.0, 9.1)), "a", "b")


@pytest.mark.thorough
@pytest.mark.parametrize(("seeds", "percent"), [(3, 7.4), (5, 1.1)])
def test_equal_methods_are_ranked_as_rarely_as_documented(seeds: int, percent: float) -> None:
    random = np.random.default_rng(4)
    draws = random.normal(size=(3000, 2, seeds))
    ranked = [apart(found(a=tuple(a), b=tuple(b)), "a", "b") for a, b in draws]
    assert 100 * np.mean(ranked) == pytest.approx(percent, abs=1.2)


@pytest.mark.parametrize(
    ("seeds", "why"), [(1, "3 seeds, this study has 1"), (2, "3 seeds, this study has 2")]
)
def test_too_few_seeds_say_so_wherever_two_rows_are_compared(seeds: int, why: str) -> None:
    text = told(
        wls=(5.0,) * seeds, delan_dissipative=(9.0,) * seeds, delan_coulomb=(1.0,) * seeds,
        proposed=(4.0,) * seeds, rc_motion=(3.0,) * seeds, ours=(0.5,) * seeds,
    )  # fmt: skip
    sentences = [line for line in text.splitlines() if "to repeat" not in line]
    assert len(sentences) == 4
    assert all(why in line for line in sentences)


def test_six_and_proposed_are_not_ranked_when_seeds_disagree() -> None:
    text = told(delan_coulomb=(1.0, 1.3, 1.1), proposed=(1.1, 1.2, 1.0))
    assert "do not differ significantly: they differ by less than two standard deviations" in text


@pytest.mark.parametrize(
    ("six", "proposed", "ahead"),
    [
        ((1.5, 1.6, 1.7), (1.0, 1.1, 1.2), "Proposed (1.1"),
        ((1.0, 1.1, 1.2), (1.5, 1.6, 1.7), "Method 6 (1.1"),
    ],
)
def test_who_is_ahead_of_six_and_proposed_is_said(
    six: tuple[float, ...], proposed: tuple[float, ...], ahead: str
) -> None:
    assert f"{ahead} N·m) has a smaller error than" in told(delan_coulomb=six, proposed=proposed)


def test_the_papers_order_is_confirmed_where_it_holds() -> None:
    five = (5.0, 5.1, 5.2)
    text = told(delan=(9.0, 9.1, 9.2), delan_dissipative=five, proposed=(1.0, 1.1, 1.2))
    assert "the ranking of the paper holds" in text


def test_the_papers_order_is_denied_where_it_does_not_hold() -> None:
    five = (5.0, 5.1, 5.2)
    text = told(delan=(4.0, 4.1, 4.2), delan_dissipative=five, proposed=(1.0, 1.1, 1.2))
    assert "ranking of the paper does not hold for Method 4 > Method 5 (dissipative)." in text
    assert "order holds" not in text


def test_the_papers_order_is_not_denied_by_seeds_that_disagree() -> None:
    text = told(delan=(4.0, 6.0, 4.9), delan_dissipative=(5.0, 5.1, 5.2))
    assert "does not hold" not in text
    assert "is not significant for Method 4 > Method 5 (dissipative): they" in text


def test_ours_is_set_against_the_best_of_one_to_six_and_the_noise() -> None:
    wls, three = (1.2, 1.2, 1.2), (9.0, 9.0, 9.0)
    text = told(wls=wls, delan=three, ours=(0.3, 0.3, 0.3), proposed=(0.1, 0.1, 0.1))
    assert "75 % less than the best of Methods 1 to 6, Method 1: WLS, 1.2 N·m." in text
    assert "closes 90 % of the gap to the noise, if the noise is white" in text


def test_without_ours_nobody_of_six_is_said_to_be_the_best() -> None:
    text = told(wls=(1.0, 1.0), irls=(1.1, 1.1))
    assert "the smallest error of Methods 1 to 6 is 1 N·m (Method 1: WLS)." in text
    assert "best" not in text


def test_ours_is_not_ahead_of_six_when_seeds_disagree() -> None:
    text = told(wls=(1.0, 1.2, 1.4), ours=(0.9, 1.3, 1.0))
    assert "1.2 N·m (not significant: they differ by less than two standard deviations" in text
    assert "gap" not in text


def test_a_correction_that_does_harm_is_said_to() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), rc_motion=(1.1, 1.1, 1.1))
    assert "10 % more than Proposed." in text


def test_a_correction_whose_seeds_disagree_is_not_told_apart() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), rc_motion=(0.8, 1.1, 0.9))
    assert "7 % less than Proposed (not significant: " in text


def test_a_correction_that_was_dropped_everywhere_takes_no_credit() -> None:
    text = told(wls=(1.0, 1.1, 1.2), ours=(0.5, 0.5, 0.6), ours_residual=(0.5, 0.5, 0.6))
    assert "ours: friction with memory yields" in text
    assert "with a residual network yields" not in text
    same = told(proposed=(1.0, 1.1, 1.2), rc_motion=(1.0, 1.1, 1.2))
    assert "Proposed with RC, no torque yields an error of 1.1 N·m, the same as Proposed." in same


def test_a_small_difference_is_not_said_to_be_none() -> None:
    text = told(proposed=(1.0, 1.1, 1.2), rc_motion=(0.999, 1.099, 1.199))
    assert "under 0.5 % less than Proposed" in text


def test_two_that_are_ahead_by_little_are_printed_with_more_digits() -> None:
    text = told(delan_coulomb=(2.0241,) * 3, proposed=(2.0182,) * 3)
    assert "Proposed (2.018 N·m) has a smaller error than Method 6 (2.024 N·m)" in text


def test_what_sees_torque_is_set_against_repeating_it() -> None:
    text = told(proposed=(1.0, 1.0), rc_history=(0.8, 0.8))
    assert "torque history at least 24 ms old yields an error of 0.8 N·m; repeating the" in text
    assert "repeating the torque of 24 ms ago yields 0.9 N·m" in text


@pytest.mark.parametrize(("rate_hz", "ms"), [(1000.0, "20"), (125.0, "24"), (500.0, "20")])
def test_a_history_is_as_old_as_whole_samples_of_the_data_are(rate_hz: float, ms: str) -> None:
    words = ROWS["rc-history"].words_at(rate_hz)
    assert words == f"Proposed with RC, torque history at least {ms} ms old"
    assert ROWS["rc-motion"].words_at(rate_hz) == ROWS["rc-motion"].words


def test_what_the_loops_add_is_said_with_its_doubt() -> None:
    text = told(proposed_joint=(1.0, 1.1, 1.2), proposed=(0.8, 1.2, 1.1))
    assert (
        "hybrid instead of joint learning yields an error of 1.03 N·m, 6 % less than joint" in text
    )
    assert (
        "joint learning (not significant: they differ by less than two standard deviations" in text
    )


def test_settings_as_printed_are_set_against_ours() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), proposed_literal=(3.0, 3.0, 3.0))
    assert (
        "with its settings as printed yields an error of 3 N·m, 200 % more than with ours." in text
    )


def test_only_the_split_is_said_to_be_the_papers() -> None:
    assert TITLES["paper"] == "Samples split as in the paper"
    assert f"at most {USUAL_EPOCHS['lagrangian']} epochs; the dissipative" in TEXTS["paper"][1]


def under_load(**errors: tuple[float, float]) -> str:
    """The summary of rows with these errors when nobody told of a load, and told of it."""
    bare = found(**dict.fromkeys(errors, (1.0, 1.0)))
    for name, (unaware, aware) in errors.items():
        for score in bare.scores[name.replace("_", "-")]:
            score.unaware[3], score.aware[3] = np.full(2, unaware), np.full(2, aware)
    return "\n".join(summary([replace(bare, loads={3: "5 kg"})]))


def test_a_load_nobody_told_of_is_set_against_one_that_was_told() -> None:
    text = under_load(wls=(9.0, 1.5), ours=(9.5, 0.6))
    assert (
        "with 5 kg: without information about it, the smallest error is 9 N·m (Method 1: WLS); "
        in text
    )
    assert (
        "; with this information, the smallest error is 0.6 N·m (ours: friction with memory)."
        in text
    )


def test_who_is_handed_the_torque_does_not_bear_a_load_nobody_told_of_best() -> None:
    text = under_load(rc_paper=(0.2, 0.1), wls=(9.0, 1.5))
    assert "without information about it, the smallest error is 9 N·m (Method 1: WLS)" in text
    assert "with this information, the smallest error is 1.5 N·m (Method 1: WLS)" in text
    assert f"0.2 N·m ({ROWS['rc-paper'].words}) is the smallest error of the rows that use" in text
    assert "use the measured torque, which contains the effect of the load" in text


def test_who_says_nothing_under_a_load_is_not_the_best_there() -> None:
    text = under_load(lmi=(np.nan, np.nan), wls=(9.0, 1.5))
    assert "without information about it, the smallest error is 9 N·m (Method 1: WLS)" in text
