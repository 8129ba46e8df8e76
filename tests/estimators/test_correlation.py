"""The correlation time of processes whose true one is known."""

import numpy as np
import pytest

from hil.data.filters import zero_phase
from hil.estimators.covariance import correlated_samples


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
