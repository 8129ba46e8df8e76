"""Folds, selection per joint, and the trivial observer."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.data import Dataset
from hil.data.metrics import persistence, persistence_rmse
from hil.estimators import estimator
from hil.networks.residual_selection import fold_of_rows, physics_of, select
from tests.support.synthetic_motion import moving, nominal

TRAJECTORIES = np.repeat(np.arange(5), 100)


def errors(scale: float, seed: int = 0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(500, 1))


def test_a_network_that_gains_on_every_trajectory_is_kept() -> None:
    found = select(errors(1.0), errors(0.8, 1), TRAJECTORIES, 0.02)
    assert found.kept.tolist() == [True]
    assert found.corrected[0] / found.without[0] == pytest.approx(0.8, rel=0.1)
    assert found.better.tolist() == [1.0]


@pytest.mark.parametrize(("gain", "kept"), [(0.99, False), (0.96, True)])
def test_less_than_the_margin_does_not_count(gain: float, kept: bool) -> None:
    found = select(errors(1.0), errors(gain), TRAJECTORIES, 0.02)
    assert found.kept.tolist() == [kept]


def test_a_gain_on_a_single_trajectory_does_not_count() -> None:
    corrected = errors(1.03)
    corrected[:100] *= 0.1
    assert not select(errors(1.0), corrected, TRAJECTORIES, 0.02).kept.any()
    assert select(errors(1.0), corrected, TRAJECTORIES, 0.0).kept.all()


def test_one_trajectory_says_nothing_of_others() -> None:
    assert not select(errors(1.0), errors(0.5), np.zeros(500, dtype=int), 0.02).kept.any()


def test_joints_decide_for_themselves() -> None:
    without = np.hstack([errors(1.0), errors(1.0)])
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
