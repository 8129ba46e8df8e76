"""Ridge is scikit-learn's; total least squares finds what least squares shrinks."""

import numpy as np
import pytest
from scipy.optimize import minimize
from sklearn.linear_model import Ridge as SkRidge

from hil.core.errors import FitError
from hil.estimators.least_squares import ALPHAS, left_out_ridge, ridge, rough, total_least_squares


def problem(seed=0, N=120):
    random = np.random.default_rng(seed)
    X = random.normal(size=(N, 4)) * [1.0, 30.0, 0.02, 5.0]
    return X, X @ [1.0, -0.1, 40.0, 0.3] + random.normal(size=N)


@pytest.mark.parametrize("alpha", [1e-6, 0.01, 3.0])
def test_ridge_is_scikit_learns_on_columns_of_length_one(alpha) -> None:
    X, y = problem()
    length = np.linalg.norm(X, axis=0)
    wanted = SkRidge(alpha=alpha, fit_intercept=False).fit(X / length, y).coef_ / length
    assert ridge(X, y, alpha, np.ones(4, bool)) == pytest.approx(wanted, rel=1e-8)


def test_a_column_left_alone_is_not_pulled_to_zero() -> None:
    X, y = problem()
    free = np.array([True, True, True, False])
    assert ridge(X, y, 1e9, free)[3] == pytest.approx(
        np.linalg.lstsq(X[:, 3:], y, rcond=None)[0][0], rel=1e-6
    )


def hard_to_tell_apart(seed):
    random = np.random.default_rng(seed)
    X = random.normal(size=(12, 1)) + 0.2 * random.normal(size=(12, 4))
    return X, X.sum(axis=1) + 2.0 * random.normal(size=12)


def test_the_penalty_is_the_one_that_predicts_a_trajectory_left_out_best() -> None:
    parts = [hard_to_tell_apart(seed) for seed in range(4)]
    best = left_out_ridge(parts, np.ones(4, bool))
    by_hand = []
    for alpha in ALPHAS:
        squares = 0.0
        for out in range(4):
            X, y = (
                np.concatenate([parts[k][side] for k in range(4) if k != out]) for side in (0, 1)
            )
            length = np.linalg.norm(X, axis=0)
            fitted = SkRidge(alpha=alpha, fit_intercept=False, solver="svd").fit(X / length, y)
            squares += np.sum((parts[out][0] / length @ fitted.coef_ - parts[out][1]) ** 2)
        by_hand.append(squares)
    assert best.errors == pytest.approx(by_hand, rel=1e-6)
    assert best.alpha == ALPHAS[int(np.argmin(by_hand))] > 0


def noisy_line(N=20000, share=0.5):
    random = np.random.default_rng(2)
    true = random.normal(size=(N, 2))
    X = np.column_stack([true + share * random.normal(size=true.shape), np.ones(N)])
    y = true @ [2.0, -1.0] + 0.7 + 0.4 * random.normal(size=N)
    return X, y, np.array([share, share, 0.0]), 0.4


def test_noise_in_the_regressor_biases_least_squares_and_not_total_least_squares() -> None:
    X, y, noise, target = noisy_line()
    plain = np.linalg.lstsq(X, y, rcond=None)[0]
    assert plain[:2] == pytest.approx([1.6, -0.8], abs=0.03)
    found = total_least_squares(X, y, noise, target, noise == 0)
    assert found.coefficients == pytest.approx([2.0, -1.0, 0.7], abs=0.03)


def test_total_least_squares_is_orthogonal_distance_regression() -> None:
    X, y, noise, target = noisy_line(N=300)
    found = total_least_squares(X, y, noise, target, noise == 0)

    def distance(beta):
        """Squared distances of the points from the plane, in their own deviations."""
        return np.sum((y - X @ beta) ** 2) / (target**2 + np.sum((noise * beta) ** 2))

    wanted = minimize(distance, np.zeros(3), method="BFGS", options={"gtol": 1e-6}).x
    assert found.coefficients == pytest.approx(wanted, rel=1e-4)


def test_a_regressor_that_is_mostly_noise_is_ill_posed_and_says_so() -> None:
    random = np.random.default_rng(0)
    X, y = random.normal(size=(40_000, 3)), random.normal(size=40_000)
    with pytest.raises(FitError, match="ill-posed") as caught:
        total_least_squares(X, y, np.ones(3), 1.0, np.zeros(3, bool))
    assert "method: wls" in caught.value.hint


def test_a_narrow_gap_is_noted_and_a_wide_one_is_not() -> None:
    X, y, noise, target = noisy_line(share=0.5)
    assert total_least_squares(X, y, noise, target, noise == 0).note == ""
    X, y, noise, target = noisy_line(share=1.2)
    assert "magnified" in total_least_squares(X, y, noise, target, noise == 0).note


def test_noise_on_smooth_columns_is_told_from_their_steps() -> None:
    random, t = np.random.default_rng(1), np.arange(4000) / 100.0
    smooth = np.column_stack([np.sin(t), np.sign(np.sin(t))])
    assert rough(smooth + 0.03 * random.normal(size=smooth.shape)) == pytest.approx(0.03, rel=0.05)
    assert rough(smooth) == pytest.approx(0.0, abs=1e-5)
