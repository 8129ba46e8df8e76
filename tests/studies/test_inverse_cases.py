"""What the study of inverse dynamics fits to and judges on: whole motions apart, leaks refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.data.dataset import Dataset
from hil.data.prediction import Prediction
from hil.data.splits import PART, TEST, groups
from hil.estimators.rigid_linear import RigidWls
from hil.studies import inverse_fits
from hil.studies.inverse_cases import (
    Case,
    honest_case,
    paper_case,
    persistence_of,
    recorded,
    white_noise_left,
)
from hil.studies.inverse_fits import judged
from tests.support.inverse_parts import run_of
from tests.support.synthetic_motion import nominal


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
            ", of which rate_hz keeps 50 a second",
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
