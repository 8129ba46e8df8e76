"""Fewer points must not hide anything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.report.curves import binned, decimated, extremes, summarised, thinned


@given(st.integers(1, 5000), st.integers(0, 2**32 - 1), st.integers(4, 400))
def test_the_extremes_and_both_ends_survive_decimation(n, seed, points):
    values = np.random.default_rng(seed).standard_normal(n)
    rows = extremes(values, points)
    assert len(rows) <= points
    assert np.all(np.diff(rows) > 0)
    assert {0, n - 1, int(values.argmin()), int(values.argmax())} <= set(rows.tolist())


def test_a_single_spike_in_half_a_million_samples_is_still_there():
    y = np.zeros(560_000)
    y[123_457] = 7.0
    x, kept = decimated(np.arange(len(y)) / 125.0, y)
    assert kept.max() == 7.0
    assert x[kept.argmax()] == 123_457 / 125.0


def test_a_gap_of_nan_stays_a_gap_and_nan_hides_no_extreme():
    y = np.sin(np.arange(50_000) / 500.0)
    y[20_000:30_000] = np.nan
    y[100] = 3.0
    y[101] = np.nan
    x, kept = decimated(np.arange(len(y), dtype=float), y, 400)
    assert np.nanmax(kept) == 3.0
    assert np.isnan(kept[(x > 20_500) & (x < 29_500)]).all()


def test_short_lines_are_left_alone():
    y = np.array([3.0, np.nan, 1.0])
    np.testing.assert_array_equal(extremes(y, 4), [0, 1, 2])


def test_thinning_keeps_both_ends_and_spreads_evenly():
    rows = thinned(10_000, 100)
    assert (rows[0], rows[-1], len(rows)) == (0, 9_999, 100)
    assert np.ptp(np.diff(rows)) <= 1


def test_binned_means_and_deviations_are_those_of_scipy():
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-3, 3, 4000), rng.standard_normal(4000)
    centres, mean, spread = binned(x, y, 20)
    expected = stats.binned_statistic(x, y, "mean", 20)
    np.testing.assert_allclose(mean, expected.statistic)
    np.testing.assert_allclose(spread, stats.binned_statistic(x, y, "std", 20).statistic)
    np.testing.assert_allclose(centres, (expected.bin_edges[1:] + expected.bin_edges[:-1]) / 2)


def test_bins_with_hardly_a_sample_are_left_out():
    x = np.concatenate([np.zeros(50), [10.0]])
    assert len(binned(x, x, 10, least=5)[0]) == 1


def test_an_envelope_keeps_the_largest_and_a_trend_the_mean():
    x = np.arange(30_000, dtype=float)
    y = np.abs(np.sin(x))
    y[777] = 9.0
    assert summarised(x, y, "upper")[1].max() == 9.0
    t, mean = summarised(x, y, "mean")
    assert len(t) == 300
    np.testing.assert_allclose(mean[10:], 2 / np.pi, atol=0.05)
