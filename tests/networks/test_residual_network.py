"""The estimator `residual`: what it adds to physics, where it is dropped, what it promises."""

from __future__ import annotations

import json
import re
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.core.typing import FloatArray
from hil.data import Dataset
from hil.data.metrics import persistence, persistence_rmse
from hil.estimators import estimator
from hil.networks.residual_data import Motions, ResidualSettings
from hil.networks.residual_selection import (
    NO_FOLD,
    Judged,
    Learnt,
    Physics,
    fold_of_rows,
    physics_of,
    select,
)
from tests.support.residual_models import SHORT, SMOOTH, known, model, unfitted, unknown
from tests.support.synthetic_motion import moving, nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.core import json_value
from hil.core.errors import DataError, FitError
from hil.data.splits import SAMPLE_SPLIT_PROTOCOL, TEST, TRAINING, VALIDATION, with_part
from hil.estimators.base import HONEST, load_model_file
from hil.estimators.model_file import save_model
from hil.evaluation import evaluate
from hil.networks.residual_network import ResidualNetwork
from hil.networks.training import Told


@pytest.mark.thorough
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
def test_rows_that_are_judged_are_not_learned_from() -> None:
    part = np.full(len(known()), TRAINING)
    part[known().offsets[2] : known().offsets[3]] = VALIDATION
    part[known().offsets[3] :] = TEST
    fitted, spoilt = (
        unfitted().fit(with_part(data, part), nominal()).fitted_arrays()
        for data in (known(), _spoilt(known(), 3))
    )
    assert all(np.array_equal(spoilt[k], a) for k, a in fitted.items())


@pytest.mark.thorough
def test_rows_drawn_one_by_one_are_labelled_as_the_papers_protocol() -> None:
    part = np.random.default_rng(0).choice([TRAINING, VALIDATION, TEST], len(known()))
    torn = unfitted().fit(with_part(known(), part), nominal())
    assert torn.protocol == SAMPLE_SPLIT_PROTOCOL
    assert "mixed their torque into these" in " ".join(torn.notes_)
    assert len(torn.correction_.networks) == 1
    assert model().protocol == HONEST
    assert "mixed their torque" not in " ".join(model().notes_)


@pytest.mark.thorough
def test_a_fitted_model_can_be_corrected() -> None:
    base = estimator("rigid-wls", sign_width=0.02).fit(known(), nominal())
    fitted = unfitted(base=None).fit_on(base, known(), nominal(), refit=False)
    assert fitted.base_ is base
    assert fitted.get_params()["base"]["sign_width"] == 0.02
    assert "was possibly fitted to the trajectories" in " ".join(fitted.notes_)


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
        (_wild, "are impossible"),
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
    with pytest.raises(FitError, match="predicts a current, the data contain a torque"):
        fresh.fit_on(base, moving(1, 2, kind="torque"), nominal())
    with pytest.raises(FitError, match="for the robot model ur5, but this robot is another"):
        fresh.fit_on(base, known(), another)
    with pytest.raises(FitError, match="not fitted yet"):
        fresh.fit_on(estimator("rigid-wls"), known(), nominal())
    assert fresh.base == SMOOTH


def test_recordings_of_another_rate_are_refused() -> None:
    slow = unknown().with_columns(t=2.0 * unknown()["t"])
    with pytest.raises(DataError, match="trained at 100 Hz"):
        model().predict(slow)
    with pytest.raises(FitError, match="residual network needs one sample rate"):
        unfitted().fit(Dataset.concatenate([known(), slow]), nominal())


def test_a_short_motion_of_another_rate_is_refused_beside_a_long_one() -> None:
    short = moving(11, samples=300)
    short = short.with_columns(t=2.0 * short["t"])
    with pytest.raises(DataError, match="residual network needs one sample rate"):
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
    assert any(
        "holding the torque that was measured 30 ms earlier" in note for note in heard.notes_
    )
    with pytest.raises(FitError, match="cannot be streamed"):
        heard.stream()


def test_the_physics_label_is_kept() -> None:
    assert unfitted(inputs="measured").protocol == "paper: measured torque among the inputs"
    assert unfitted(base={**SMOOTH}).protocol == HONEST


def _spoilt(data: Dataset, series: int) -> Dataset:
    effort = data["effort"].copy()
    effort[data.offsets[series] : data.offsets[series + 1]] *= 1.5
    return data.with_columns(effort=effort, effort_f=effort)


# On disk and as a stream


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("base", "estimator"), "rigid-hysteresis"),
        (("base", "fitted", "joint_names"), ["a"] * 6),
        (("networks",), 1000),
        (("networks",), 1),
        (("networks",), 0),
        (("residual", "kernel"), 4),
        (("selection", 0, "kept"), None),
        (("curves",), {}),
    ],
)
def test_garbled_documents_are_refused(tmp_path: Path, keys, value) -> None:
    folder = save_model(model(), tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    at = document["fitted"]
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = (not at[keys[-1]]) if value is None else value
    (folder / "model.json").write_text(json.dumps(document))
    with pytest.raises(DataError):
        load_model_file(folder)


@pytest.mark.parametrize("rate_hz", [0.0, -100.0, np.inf])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    arrays = model().fitted_arrays() | {"network2.rate_hz": np.array([rate_hz])}
    fresh = type(model())(**model().get_params())
    fresh.robot_ = model().robot_
    with pytest.raises((ValueError, DataError)):
        fresh.restore(arrays, json_value(model().fitted_facts()))


# Folds, selection per joint, the trivial observer

TRAJECTORIES = np.repeat(np.arange(5), 100)


def normal_errors(scale: float, seed: int = 0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(500, 1))


def test_a_network_that_gains_on_every_trajectory_is_kept() -> None:
    found = select(normal_errors(1.0), normal_errors(0.8, 1), TRAJECTORIES, 0.02)
    assert found.kept.tolist() == [True]
    assert found.corrected[0] / found.without[0] == pytest.approx(0.8, rel=0.1)
    assert found.better.tolist() == [1.0]


@pytest.mark.parametrize(("gain", "kept"), [(0.99, False), (0.96, True)])
def test_less_than_the_margin_does_not_count(gain: float, kept: bool) -> None:
    found = select(normal_errors(1.0), normal_errors(gain), TRAJECTORIES, 0.02)
    assert found.kept.tolist() == [kept]


def test_a_gain_on_a_single_trajectory_does_not_count() -> None:
    corrected = normal_errors(1.03)
    corrected[:100] *= 0.1
    assert not select(normal_errors(1.0), corrected, TRAJECTORIES, 0.02).kept.any()
    assert select(normal_errors(1.0), corrected, TRAJECTORIES, 0.0).kept.all()


def test_one_trajectory_says_nothing_of_others() -> None:
    assert not select(
        normal_errors(1.0), normal_errors(0.5), np.zeros(500, dtype=int), 0.02
    ).kept.any()


def test_joints_decide_for_themselves() -> None:
    without = np.hstack([normal_errors(1.0), normal_errors(1.0)])
    found = select(without, without * [0.5, 1.1], TRAJECTORIES, 0.02)
    assert found.kept.tolist() == [True, False]
    kept, dropped = found.notes(("hip", "knee"), "A")
    assert "kept for hip (" in kept
    assert "dropped for knee (" in dropped


@pytest.mark.thorough
def test_physics_says_nothing_of_a_trajectory_it_was_fitted_to() -> None:
    data = moving(1, 2, 3, 4)
    spoilt = data["effort"].copy()
    spoilt[: data.offsets[1]] += 5.0
    held = slice(0, int(data.offsets[1]))
    clean, dirty = (
        physics_of(d, wls(d), 2, 0, lambda part, fold: wls(part))
        for d in (data, data.with_columns(effort=spoilt, effort_f=spoilt))
    )
    assert np.array_equal(clean.predicted[held], dirty.predicted[held])
    assert not np.allclose(clean.predicted[held], dirty.model.predict(data).effort[held])


def test_loads_of_a_trajectory_are_in_the_same_fold() -> None:
    data = Dataset.concatenate([moving(1, 2, 3), moving(1, 2, 3)])
    fold = fold_of_rows(data, 3, 0)
    half = len(data) // 2
    assert np.array_equal(fold[:half], fold[half:])
    assert sorted(set(fold.tolist())) == [0, 1, 2]


def test_a_single_trajectory_has_no_folds() -> None:
    assert np.all(fold_of_rows(moving(1), 3, 0) == -1)


def test_persistence_holds_what_is_old_enough_within_a_series() -> None:
    data = moving(1, 2)
    held = persistence(data, 0.03)
    assert np.all(np.isnan(held[:3]))
    assert np.array_equal(held[3:600], data["effort"][:597])
    assert np.all(np.isnan(held[600:603]))
    assert np.array_equal(held[603:], data["effort"][600:1197])
    expected = np.sqrt(np.mean((data["effort"][3:600] - data["effort"][:597]) ** 2, axis=0))
    found = persistence_rmse(data, 0.03, rows=np.arange(len(data)) < 600)
    assert found == pytest.approx(expected)


def test_a_latency_of_zero_would_be_the_answer() -> None:
    with pytest.raises(SpecError, match="latency"):
        persistence(moving(1), 0.0)


def wls(data: Dataset):
    return estimator("rigid-wls").fit(data, nominal())


# Rows left out judge a correction as predictions give it


class Wild:
    """A network that knows all that is left, but shouts now and then."""

    settings = ResidualSettings()

    def __init__(self, left: FloatArray) -> None:
        self.said = left.copy()
        self.said[::100] *= 1e3

    def predict(self, motions: Motions) -> FloatArray:
        return self.said


def verdict() -> tuple[Judged, FloatArray, FloatArray]:
    """The verdict on such a network, what the physics left, and what predictions add to it."""
    data, everything = known(), np.ones(len(known()), dtype=bool)
    left = np.random.default_rng(5).normal(size=data["effort_f"].shape)
    physics: Any = None
    predicted = data["effort_f"] - left
    of = Physics(physics, predicted, everything, np.full(len(data), NO_FOLD))
    network: Any = Wild(left)
    learnt = Learnt((network,), network.said, everything, everything, ())
    found = Judged.of(data, of, learnt, margin=0.02, coverage=0.9)
    return found, left, found.correction.predict(data, predicted)


def test_what_no_prediction_says_does_not_cost_a_joint_its_network() -> None:
    found, left, _ = verdict()
    assert found.selection.kept.all()
    assert np.allclose(found.correction.limit, np.max(np.abs(left), axis=0))


def test_the_errors_told_are_those_of_predictions() -> None:
    found, left, added = verdict()
    errors = np.sqrt(np.mean((left - added) ** 2, axis=0))
    assert np.allclose(found.selection.corrected, errors)
    raw = known()["effort"] - known()["effort_f"] + left - added
    assert np.allclose(found.sigma, np.sqrt(np.mean(raw**2, axis=0)))


# What a network that hears torque says beside the trivial observer

BRIEF = {"epochs": 1, "batch_size": 64, "device": "cpu"}
NOTE = re.compile(r"holding .* measured (.+) ms earlier .* error of (.+) A on .*, this model (.+)")


def told(data: Dataset, **changed) -> tuple[float, float, float]:
    """The age in the note [ms], the error of holding, and that of the model."""
    made = unfitted(training=BRIEF, margin=0.0, **changed).fit(data, nominal())
    (found,) = filter(None, map(NOTE.fullmatch, made.notes_))
    age, held, ours = map(float, found.groups())
    return age, held, ours


def loud() -> Dataset:
    """Torque with noise of 1 A as recorded, of which the filter leaves little."""
    data = moving(1, 2, 3, 4, noise_a=1.0)
    return data.with_columns(effort_f=moving(1, 2, 3, 4)["effort"])


@pytest.mark.thorough
def test_a_history_and_the_network_that_hears_it_are_judged_on_the_torque_as_recorded() -> None:
    _, held, ours = told(loud(), inputs="history", base={"estimator": "rigid-wls"})
    assert ours > 0.95
    assert held > 1.2


def test_the_papers_torque_and_its_network_are_judged_on_the_filtered_torque() -> None:
    _, held, ours = told(loud(), inputs="measured", base={"estimator": "rigid-wls"})
    assert max(held, ours) < 0.5


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("inputs", "latency_s", "age_ms"),
    [("measured", 0.02, 10.0), ("history", 0.02, 20.0), ("history", 0.012, 20.0)],
)
def test_the_age_told_is_that_of_the_sample_held(inputs, latency_s, age_ms) -> None:
    data = known()
    age, held, _ = told(data, inputs=inputs, latency_s=latency_s)
    lag = round(age_ms / 10.0)
    steps = [data["effort"][rows][lag:] - data["effort"][rows][:-lag] for _, rows in data.slices()]
    assert age == pytest.approx(age_ms)
    assert held == pytest.approx(np.mean(np.sqrt(np.mean(np.concatenate(steps) ** 2, 0))), rel=5e-3)


# On a network: all trainings are kept, those of its physics as well

QUICK = SHORT | {"epochs": 2, "batch_size": 400}
NETWORK = {
    "estimator": "lagrangian", "network": {"hidden": [8]}, "friction": "coulomb",
    "learning": "joint", "training": QUICK,
}  # fmt: skip
PHYSICS = ("physics", "fold-1", "fold-2")


def fitted(folder: Path | None, stop_at: int = 0) -> tuple[ResidualNetwork, int]:
    """The model, and how many epochs were trained for it."""
    told: list[Told] = []

    def watch(epoch: Told) -> None:
        told.append(epoch)
        if len(told) == stop_at:
            raise KeyboardInterrupt

    model = unfitted(base=NETWORK, training=QUICK)
    model.watch_, model.checkpoints_ = watch, folder
    return model.fit(known(), nominal()), len(told)


@pytest.mark.thorough
def test_a_fit_goes_on_where_the_training_of_its_physics_stood(tmp_path: Path) -> None:
    whole, epochs = fitted(None)
    assert epochs == 2 * len((*PHYSICS, "network-1", "network-2"))
    with pytest.raises(KeyboardInterrupt):
        fitted(tmp_path, stop_at=4)
    assert {one.name for one in tmp_path.iterdir()} == {"physics", "fold-1"}
    resumed, left = fitted(tmp_path)
    assert left == epochs - 3  # the epoch at work is trained again
    expected, found = whole.fitted_arrays(), resumed.fitted_arrays()
    assert all(np.array_equal(found[name], value) for name, value in expected.items())


def test_physics_that_trains_nothing_is_given_no_folder(tmp_path: Path) -> None:
    model = unfitted(base=SMOOTH, training=QUICK)
    model.checkpoints_ = tmp_path
    model.fit(known(), nominal())
    assert {one.name for one in tmp_path.iterdir()} == {"network-1", "network-2"}
