"""Covariances and correlation times of fits: statsmodels' and the textbook's."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import statsmodels.api as sm

from hil.data.filters import zero_phase
from hil.estimators.covariance import (
    Scores,
    correlated_samples,
    hac_covariance,
    hac_window,
    trajectory_covariance,
)
from hil.estimators.regression import ClusteredLeastSquares

LENGTHS = (180, 250, 70)


@pytest.fixture(scope="module")
def problem():
    """One observation per instant with errors that last some ten samples, in three series."""
    random, N = np.random.default_rng(0), sum(LENGTHS)
    X = np.column_stack([random.normal(size=N), np.sin(np.arange(N) / 9.0), np.ones(N)])
    error = np.convolve(random.normal(size=N + 9), np.ones(10) / 3, "valid")
    return X, X @ [1.0, -2.0, 0.5] + error


def scores_of(X, residual, lengths):
    offsets = np.concatenate(([0], np.cumsum(lengths)))
    rows = [slice(a, b) for a, b in pairwise(offsets)]
    gram = np.stack([X[own].T @ X[own] for own in rows])
    return Scores(X * residual[:, None], gram, offsets, 1)


@pytest.mark.parametrize("window", [1, 7, 40])
def test_hac_of_one_series_is_newey_west_by_statsmodels(problem, window) -> None:
    X, y = problem
    fitted = sm.OLS(y, X).fit()
    wanted = fitted.get_robustcov_results("HAC", maxlags=window - 1, use_correction=True)
    found = hac_covariance(np.linalg.inv(X.T @ X), scores_of(X, fitted.resid, [len(X)]), window)
    assert found.covariance == pytest.approx(wanted.cov_params(), rel=1e-9)


def test_hac_of_several_series_is_the_panel_kind_by_statsmodels(problem) -> None:
    X, y = problem
    fitted = sm.OLS(y, X).fit()
    wanted = fitted.get_robustcov_results(
        "hac-panel",
        groups=np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        maxlags=11,
        use_correction="hac",
    )
    found = hac_covariance(np.linalg.inv(X.T @ X), scores_of(X, fitted.resid, LENGTHS), 12)
    assert found.covariance == pytest.approx(wanted.cov_params(), rel=1e-9)


def test_trajectories_as_clusters_are_what_clustered_least_squares_says(problem) -> None:
    X, y = problem
    lengths = [50] * 10
    fitted = ClusteredLeastSquares().fit(X, y, clusters=np.repeat(np.arange(10), 50))
    scores = scores_of(X, y - X @ fitted.coef_, lengths)
    found = trajectory_covariance(np.linalg.inv(X.T @ X), scores)
    assert found.covariance == pytest.approx(fitted.covariance_, rel=1e-9)
    assert found.degrees == pytest.approx(fitted.degrees_, rel=1e-9)


def test_window_grows_with_the_correlation_but_leaves_several() -> None:
    assert hac_window(np.array([1.0, 3.0]), 10_000) == 30
    assert hac_window(np.array([500.0]), 8_000) == 1_000
    assert hac_window(np.array([1.0]), 3) == 1


def test_intervals_of_correlated_errors_hold_where_independent_ones_do_not() -> None:
    random, N, runs = np.random.default_rng(5), 3000, 200
    x = np.sin(np.arange(N) / 40.0)[:, None]
    hits = {"independent": 0, "hac": 0}
    for _ in range(runs):
        error = np.convolve(random.normal(size=N + 19), np.ones(20), "valid")
        fitted = sm.OLS(x[:, 0] * 3.0 + error, x).fit()
        told = hac_covariance(1.0 / (x.T @ x), scores_of(x, fitted.resid, [N]), 200)
        hits["hac"] += abs(fitted.params[0] - 3.0) < 1.98 * np.sqrt(told.covariance[0, 0])
        hits["independent"] += abs(fitted.params[0] - 3.0) < 1.98 * fitted.bse[0]
    assert hits["hac"] / runs == pytest.approx(0.95, abs=0.05)
    assert hits["independent"] / runs < 0.6


def autoregressive(phi, samples, seed):
    noise = np.random.default_rng(seed).normal(size=(samples, len(phi)))
    out = np.zeros_like(noise)
    for k in range(1, samples):
        out[k] = phi * out[k - 1] + noise[k]
    return out


def test_first_order_processes_have_the_time_of_the_textbook() -> None:
    phi = np.array([0.0, 0.5, 0.9])
    parts = [autoregressive(phi, 5000, seed) for seed in range(4)]
    found = correlated_samples(np.concatenate(parts), np.arange(5) * 5000)
    assert found == pytest.approx((1 + phi) / (1 - phi), rel=0.15)


def test_series_that_follow_each_other_are_not_taken_for_neighbours() -> None:
    """Constant within a series of two, independent between series: two samples count as one."""
    levels = np.random.default_rng(0).normal(size=(2000, 1))
    assert correlated_samples(np.repeat(levels, 2, axis=0), np.arange(0, 4001, 2)) == pytest.approx(
        2.0, rel=0.05
    )


@pytest.mark.parametrize("samples", [0, 1])
def test_single_samples_are_independent(samples) -> None:
    assert correlated_samples(np.ones((samples, 2)), np.arange(samples + 1)).tolist() == [1.0, 1.0]


def test_alternating_noise_never_counts_for_more_than_it_is() -> None:
    assert correlated_samples(np.tile([[1.0], [-1.0]], (50, 1)), np.array([0, 100])) == [1.0]


def test_slow_part_taken_out_by_a_fit_does_not_make_a_filtered_signal_white() -> None:
    noise = zero_phase(np.random.default_rng(1).normal(size=(4000, 1)), 0.2)
    slow = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, 4000), 300)
    residual = noise - slow @ np.linalg.lstsq(slow, noise, rcond=None)[0]
    assert correlated_samples(residual, np.array([0, 4000]))[0] > 2.0
