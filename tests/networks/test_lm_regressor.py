"""The regressor keeps scikit-learn's contract."""

import numpy as np
import pytest
from sklearn.model_selection import cross_val_score
from sklearn.utils.estimator_checks import check_estimator

from hil.networks.lm_regressor import LevenbergMarquardtRegressor


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::hil.networks.lm.ConstantInputWarning")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_check_estimator_passes() -> None:
    check_estimator(LevenbergMarquardtRegressor(hidden=(5,), epochs=20))


def wave(rows=80, noise=0.0):
    random = np.random.default_rng(0)
    X = random.uniform(-2.0, 2.0, (rows, 1))
    return X, np.sin(2 * X[:, 0]) + noise * random.normal(size=rows)


def test_it_can_be_cross_validated() -> None:
    model = LevenbergMarquardtRegressor(hidden=(8,), epochs=60)
    assert cross_val_score(model, *wave(), cv=3).min() > 0.98


def test_rows_held_out_stop_the_training() -> None:
    model = LevenbergMarquardtRegressor(validation_share=0.25, patience=5, epochs=300)
    assert model.fit(*wave(noise=0.5)).history_.stopped == "patience"


def test_rows_with_equal_inputs_are_held_out_together() -> None:
    X, y = wave(20)
    twice = LevenbergMarquardtRegressor(hidden=(5,), validation_share=0.25, patience=5, epochs=30)
    once = LevenbergMarquardtRegressor(**twice.get_params()).fit(X, y)
    twice.fit(np.vstack([X, X]), np.concatenate([y, y]))
    assert twice.predict(X) == pytest.approx(once.predict(X), rel=1e-6)
