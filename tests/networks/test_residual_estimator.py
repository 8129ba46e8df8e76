"""A residual network on top of physics: what it adds, where it is dropped, and what it promises."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from tests.support.residual_models import SMOOTH, known, model, unfitted, unknown
from tests.support.synthetic_motion import LOAD, moving, nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.core.errors import DataError, FitError
from hil.data import Dataset
from hil.data.splits import SAMPLE_SPLIT_PROTOCOL, TEST, TRAINING, VALIDATION, with_part
from hil.estimators import estimator
from hil.estimators.base import HONEST
from hil.evaluation import evaluate


def test_it_lowers_the_error_on_trajectories_nobody_has_seen() -> None:
    with_network = evaluate(model(), unknown()).total.rmse_filtered
    physics = evaluate(model().base_, unknown()).total.rmse_filtered
    kept = model().correction_.kept
    assert 0 < kept.sum() < len(kept)
    assert np.all((with_network / physics)[kept] < 0.8)
    assert np.array_equal(with_network[~kept], physics[~kept])


def test_components_of_the_physics_pass_through_and_all_add_up() -> None:
    found, base = model().predict(unknown()), model().base_.predict(unknown())
    assert set(found.components) == {*base.components, "residual"}
    for name, part in base.components.items():
        assert np.array_equal(found.components[name], part)
    assert sum(found.components.values()) == pytest.approx(found.effort)


def test_loads_pass_through() -> None:
    heavy = tuple(replace(c, payload=LOAD) for c in unknown().conditions)
    found = model().predict(replace(unknown(), conditions=heavy)).components["payload"]
    loaded = replace(unknown(), conditions=heavy)
    assert np.max(np.abs(found)) > 0.1
    assert np.array_equal(found, model().base_.predict(loaded).components["payload"])


def test_bands_hold_what_they_promise_on_trajectories_nobody_has_seen() -> None:
    found = model().predict(unknown())
    inside = np.abs(unknown()["effort"] - found.effort) <= 1.645 * found.std
    assert 0.85 < np.mean(inside) < 0.99
    assert np.mean(model().coverage_["share"]) == pytest.approx(0.9, abs=0.05)


@pytest.mark.thorough
def test_noise_is_left_alone() -> None:
    data = moving(1, 2, 3, 4, noise_a=0.05)
    dropped = unfitted(base={"estimator": "rigid-wls"}).fit(data, nominal())
    assert not np.any(dropped.correction_.kept)
    new = moving(9)
    assert np.array_equal(dropped.predict(new).effort, dropped.base_.predict(new).effort)
    assert "dropped" in " ".join(dropped.notes_)


def test_corrections_stay_below_the_largest_residual_there_was() -> None:
    left = known()["effort"] - model().base_.predict(known()).effort
    assert np.all(model().correction_.limit > 0.5 * np.max(np.abs(left), axis=0))
    narrow = replace(model().correction_, limit=np.full(6, 1e-3))
    added = narrow.predict(unknown(), model().base_.predict(unknown()).effort)
    assert np.max(np.abs(added), axis=0) == pytest.approx(1e-3 * narrow.kept)


@pytest.mark.thorough
def test_equal_seeds_give_equal_models() -> None:
    again = unfitted().fit(known(), nominal()).fitted_arrays()
    assert all(np.array_equal(again[k], a) for k, a in model().fitted_arrays().items())


@pytest.mark.thorough
def test_rows_that_are_judged_are_not_learned_from() -> None:
    part = np.full(len(known()), TRAINING)
    part[known().offsets[2] : known().offsets[3]] = VALIDATION
    part[known().offsets[3] :] = TEST
    fitted, spoilt = (
        unfitted().fit(with_part(data, part), nominal()).fitted_arrays()
        for data in (known(), _spoilt(known(), 3))
    )
    assert all(np.array_equal(spoilt[k], a) for k, a in fitted.items())


def test_rows_drawn_one_by_one_are_labelled_as_the_papers_protocol() -> None:
    part = np.random.default_rng(0).choice([TRAINING, VALIDATION, TEST], len(known()))
    torn = unfitted().fit(with_part(known(), part), nominal())
    assert torn.protocol == SAMPLE_SPLIT_PROTOCOL
    assert "brought their torque into these" in " ".join(torn.notes_)
    assert len(torn.correction_.networks) == 1
    assert model().protocol == HONEST
    assert "brought their torque" not in " ".join(model().notes_)


def test_a_fitted_model_can_be_corrected() -> None:
    base = estimator("rigid-wls", sign_width=0.02).fit(known(), nominal())
    fitted = unfitted(base=None).fit_on(base, known(), nominal(), refit=False)
    assert fitted.base_ is base
    assert fitted.get_params()["base"]["sign_width"] == 0.02
    assert "may have learned from" in " ".join(fitted.notes_)


def _wild(data: Dataset) -> Dataset:
    effort = data["effort"].copy()
    effort[7, 2] = 1e6
    return data.with_columns(effort=effort)


def _still(data: Dataset) -> Dataset:
    q = data["q"].copy()
    q[:, 4] = 0.3
    return data.with_columns(q=q)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_wild, "cannot be"),
        (_still, "never moved"),
        (lambda _: moving(1, 2, samples=40), "too few"),
    ],
)
def test_data_that_no_physics_would_be_fitted_to_are_not_learned_from(spoil, words) -> None:
    with pytest.raises(FitError, match=words):
        unfitted().fit_on(model().base_, spoil(known()), nominal(), refit=False)


def test_a_model_of_another_unit_robot_or_none_cannot_be_corrected() -> None:
    base, fresh, another = model().base_, unfitted(folds=1), copy(nominal())
    another.name = "another"
    with pytest.raises(FitError, match="predicts a current, the data hold a torque"):
        fresh.fit_on(base, moving(1, 2, kind="torque"), nominal())
    with pytest.raises(FitError, match="for the robot model ur5, not for another"):
        fresh.fit_on(base, known(), another)
    with pytest.raises(FitError, match="not fitted yet"):
        fresh.fit_on(estimator("rigid-wls"), known(), nominal())
    assert fresh.base == SMOOTH


def test_recordings_of_another_rate_are_refused() -> None:
    slow = unknown().with_columns(t=2.0 * unknown()["t"])
    with pytest.raises(DataError, match="trained at 100 Hz"):
        model().predict(slow)
    with pytest.raises(FitError, match="memory of a residual network counts samples"):
        unfitted().fit(Dataset.concatenate([known(), slow]), nominal())


def test_a_short_motion_of_another_rate_is_refused_beside_a_long_one() -> None:
    short = moving(11, samples=300)
    short = short.with_columns(t=2.0 * short["t"])
    with pytest.raises(DataError, match="memory of a residual network counts samples"):
        model().predict(Dataset.concatenate([unknown(), short]))


def test_an_arm_at_rest_may_be_sampled_at_any_rate() -> None:
    still = moving(15, samples=900)
    still = replace(still, conditions=(replace(still.conditions[0], kind="dwell"),))
    still = still.with_columns(t=2.0 * still["t"])
    alone = model().predict(unknown()).effort
    beside = model().predict(Dataset.concatenate([unknown(), still])).effort
    assert np.array_equal(beside[: len(alone)], alone)


@pytest.mark.thorough
def test_torque_it_hears_is_told_beside_holding_the_last_torque() -> None:
    heard = unfitted(inputs="history", latency_s=0.03).fit(known(), nominal())
    assert heard.protocol == "honest: torque history ending at least 30 ms before"
    assert any("holding the torque measured 30 ms before" in note for note in heard.notes_)
    with pytest.raises(FitError, match="cannot be streamed"):
        heard.stream()


def test_the_physics_label_is_kept() -> None:
    assert unfitted(inputs="measured").protocol == "paper: measured torque among the inputs"
    assert unfitted(base={**SMOOTH}).protocol == HONEST


def _spoilt(data: Dataset, series: int) -> Dataset:
    effort = data["effort"].copy()
    effort[data.offsets[series] : data.offsets[series + 1]] *= 1.5
    return data.with_columns(effort=effort, effort_f=effort)
