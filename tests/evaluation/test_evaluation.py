"""Errors of a model whose mistakes are known: it predicts the truth plus what a test adds."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from hil.core.errors import SpecError
from hil.data import Dataset, Prediction
from hil.estimators import estimator
from hil.evaluation import Criterion, evaluate, judge, usable_part
from tests.support.synthetic_motion import dwelling, moving, raw


@dataclass
class Oracle:
    """Predicts `truth + wrong`."""

    truth: np.ndarray
    wrong: float | np.ndarray = 0.0
    valid: np.ndarray | None = None
    estimator = "oracle"

    def predict(self, dataset: Dataset) -> Prediction:
        effort = self.truth + self.wrong
        valid = np.ones(effort.shape, dtype=bool) if self.valid is None else self.valid
        return Prediction(effort, np.full(effort.shape, np.nan), valid)

    def stream(self):
        raise NotImplementedError


def noisy(*seeds, noise=0.1):
    data = raw(moving(*seeds))
    clean = data["effort"]
    rough = clean + noise * np.random.default_rng(0).normal(size=clean.shape)
    return data.with_columns(effort=rough), clean


def rms(values):
    return np.sqrt(np.mean(values**2, axis=0))


def test_raw_filtered_and_noise_floor_are_as_defined() -> None:
    data, clean = noisy(1)
    errors = evaluate(Oracle(clean, 0.02), data).total
    b, a = butter(5, 0.20)
    smooth = filtfilt(b, a, data["effort"], axis=0)
    assert errors.rmse_raw == pytest.approx(rms(data["effort"] - clean - 0.02))
    assert errors.rmse_filtered == pytest.approx(rms(smooth - clean - 0.02), rel=1e-6)
    assert errors.noise_floor == pytest.approx(rms(data["effort"] - smooth), rel=1e-6)


def test_the_cut_off_is_told_in_hz_of_each_sample_rate() -> None:
    data, clean = noisy(1, 2, noise=0.0)
    slower = np.where(data.series_index() == 0, data["t"], 2 * data["t"])
    rate = 1 / np.diff(data["t"][:600]).mean()
    found = evaluate(Oracle(clean), data.with_columns(t=slower)).to_dict()["cutoff_hz"]
    assert found == pytest.approx([0.05 * rate, 0.1 * rate])


def test_dwells_have_no_cut_off() -> None:
    data = dwelling(5)
    assert evaluate(Oracle(data["effort"]), data).to_dict()["cutoff_hz"] is None


def test_what_the_filter_takes_away_is_no_bound_for_the_raw_error() -> None:
    data, clean = noisy(1, noise=0.0)
    steps = clean + 0.5 * np.sign(data["qd"])
    errors = evaluate(Oracle(steps, 1e-3), data.with_columns(effort=steps)).total
    assert np.all(errors.rmse_raw < 0.1 * errors.noise_floor)


def test_measured_signal_is_filtered_series_by_series() -> None:
    data, clean = noisy(1, 2)
    apart = [noisy_part(data, clean, rows) for _, rows in data.slices()]
    squares = np.mean([e.rmse_filtered**2 for e in apart], axis=0)
    assert evaluate(Oracle(clean), data).total.rmse_filtered == pytest.approx(np.sqrt(squares))


def noisy_part(data, clean, rows):
    part = data.select(lambda c: c.trajectory == data.conditions[rows.start // 600].trajectory)
    return evaluate(Oracle(clean[rows]), part).total


def test_every_grouping_has_its_own_errors() -> None:
    data, clean = noisy(1, 2, noise=0.0)
    wrong = np.repeat([0.1, 0.3], 600)[:, None]
    found = evaluate(Oracle(clean, wrong), data)
    assert [(e.name, e.samples) for e in found.table("trajectory")] == [
        ("run1#1", 600),
        ("run2#2", 600),
    ]
    for by in ("trajectory", "source"):
        assert [e.mean("rmse_raw") for e in found.table(by)] == pytest.approx([0.1, 0.3])
    assert [e.name for e in found.table("load")] == ["0: 0 kg"]
    assert [e.name for e in found.table("kind")] == ["trajectory"]
    assert found.total.mean("rmse_raw") == pytest.approx(np.sqrt((0.01 + 0.09) / 2))
    assert found.series == ("trajectory1", "trajectory2")


def test_moving_and_standing_joints_are_told_apart_joint_by_joint() -> None:
    data, clean = noisy(1, noise=0.0)
    wrong = np.where(np.abs(data["qd"]) > 0.05, 0.1, 0.4)
    moving_, still = evaluate(Oracle(clean, wrong), data).table("motion")
    assert (moving_.name, still.name) == ("moving", "standstill")
    assert moving_.rmse_raw == pytest.approx(0.1)
    assert still.rmse_raw == pytest.approx(0.4)


def test_dwells_are_judged_by_sample_and_by_their_mean() -> None:
    data = dwelling(30, noise_a=0.1)
    truth = np.repeat([data["effort"][rows].mean(axis=0) for _, rows in data.slices()], 10, axis=0)
    errors = evaluate(Oracle(truth, 0.03), data).total
    assert errors.rmse_filtered == pytest.approx(0.03)
    assert errors.rmse_raw == pytest.approx(rms(data["effort"] - truth - 0.03))


def test_only_rows_the_model_calls_valid_are_judged() -> None:
    data, clean = noisy(1, noise=0.0)
    valid = np.ones(clean.shape, dtype=bool)
    valid[:150] = False
    wrong = np.where(valid, 0.1, 9.0)
    found = evaluate(Oracle(clean, wrong, valid), data)
    assert found.coverage == pytest.approx(0.75)
    assert found.total.samples == 450
    assert found.total.rmse_raw == pytest.approx(0.1)


def test_training_deviation_is_the_scale_of_nrmse_when_given() -> None:
    data, clean = noisy(1, noise=0.0)
    found = evaluate(Oracle(clean, 0.1), data, train_std=np.full(6, 2.0))
    assert found.total.nrmse == pytest.approx(0.05)


def test_json_form_is_strict_json_with_null_for_the_unknown() -> None:
    data, clean = noisy(1, noise=0.0)
    still = data.with_columns(qd=np.zeros_like(data["qd"]))
    document = evaluate(Oracle(clean), still).to_dict()
    text = json.dumps(document, allow_nan=False)
    (nothing,) = [t for t in json.loads(text)["tables"] if t["name"] == "moving"]
    assert nothing["rmse_raw"] == [None] * 6
    assert nothing["mean_raw"] is None
    assert document["unit"] == "A"


@pytest.fixture
def evaluation():
    data, clean = noisy(1, noise=0.0)
    return evaluate(Oracle(clean, np.array([0.1, 0.2, 0.3, 0.1, 0.1, 0.1])), data)


def test_every_joint_must_meet_a_criterion_per_joint(evaluation) -> None:
    verdict = judge(evaluation, [Criterion("rmse_raw", 0.25, "A", "joint")])
    assert not verdict.passed
    assert [row.passed for row in verdict.rows] == [True, True, False, True, True, True]
    assert verdict.rows[2].what == "elbow_joint"
    assert verdict.rows[2].value == pytest.approx(0.3)


def test_mean_may_pass_where_a_joint_fails(evaluation) -> None:
    assert judge(evaluation, [Criterion("rmse_raw", 0.2, "A")]).passed
    assert not judge(evaluation, [Criterion("rmse_raw", 0.1, "A")]).passed


def test_all_criteria_must_be_met(evaluation) -> None:
    both = [Criterion("rmse_raw", 0.2, "A"), Criterion("mep", 0.001)]
    verdict = judge(evaluation, both)
    assert [row.passed for row in verdict.rows] == [True, False]
    assert verdict.to_dict()["verdict"] == "fail"


def test_without_criteria_nothing_is_judged(evaluation) -> None:
    verdict = judge(evaluation, [])
    assert (verdict.word, verdict.judged) == ("not judged", False)


def test_error_that_could_not_be_computed_fails(evaluation) -> None:
    blind = replace(evaluation, total=replace(evaluation.total, rmse_raw=np.full(6, np.nan)))
    verdict = judge(
        blind, [Criterion("rmse_raw", 0.5, "A"), Criterion("rmse_raw", 1, "A", "joint")]
    )
    assert not any(row.passed for row in verdict.rows)
    json.dumps(verdict.to_dict(), allow_nan=False)


def test_criterion_in_another_unit_is_refused(evaluation) -> None:
    with pytest.raises(SpecError, match="in N·m, but the data are in A"):
        judge(evaluation, [Criterion("rmse_raw", 0.5, "Nm")])


def test_criterion_for_an_unknown_metric_is_refused() -> None:
    with pytest.raises(SpecError, match="'rsme' cannot be a criterion"):
        Criterion("rsme", 0.5)


def test_moves_too_short_for_a_filter_are_left_out_where_there_are_longer_ones() -> None:
    data = raw(moving(1, 2, 3))
    ends = data.offsets.copy()
    ends[-1] = ends[-2] + 14  # as if an axis had slipped in the middle of a dwell
    moves = tuple(replace(condition, kind="move") for condition in data.conditions)
    columns = {name: values[: ends[-1]] for name, values in data.columns.items()}
    slipped = replace(data, columns=columns, offsets=ends, conditions=moves)
    model = estimator("rigid-wls")
    assert usable_part(slipped, model).conditions == moves[:2]
    trajectories = replace(slipped, conditions=data.conditions)
    assert usable_part(trajectories, model).conditions == data.conditions
    assert usable_part(slipped.take([2]), model).conditions == moves[2:]
