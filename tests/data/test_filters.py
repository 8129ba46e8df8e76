import numpy as np
import pytest
from pydantic import ValidationError
from scipy.signal import butter, filtfilt, savgol_filter

from hil.core.errors import DataError
from hil.data import Conditions, Dataset
from hil.data.filters import (
    FilterSettings,
    derivative,
    downsample,
    downsampling_mask,
    filter_columns,
    nyquist_fraction,
    polynomial_derivative,
    prepare,
    sample_rate,
    zero_phase,
)
from tests.support.synthetic_motion import dataset, fourier, moving, raw


@pytest.fixture
def noise():
    return np.random.default_rng(0).normal(size=(300, 6)).cumsum(axis=0)


@pytest.mark.parametrize("order", [2, 5])
@pytest.mark.parametrize("fraction", [0.05, 0.2, 0.8])
def test_zero_phase_filter_is_scipys_filtfilt(noise, order, fraction) -> None:
    b, a = butter(order, fraction)
    assert zero_phase(noise, fraction, order) == pytest.approx(
        filtfilt(b, a, noise, axis=0), abs=1e-8
    )


def test_zero_phase_filter_does_not_delay_a_slow_sine() -> None:
    t = np.arange(500) / 100.0
    wave = np.sin(2 * np.pi * 0.5 * t)[:, None]
    assert zero_phase(wave, 0.2)[100:-100] == pytest.approx(wave[100:-100], abs=1e-6)


def test_cutoff_close_to_nyquist_is_refused_with_the_highest_possible() -> None:
    with pytest.raises(DataError, match=r"0\.9 of the Nyquist") as caught:
        nyquist_fraction(45.0, "hz", 100.0)
    assert "40 (hz)" in caught.value.hint


def test_a_clock_that_runs_a_little_slow_may_be_filtered_up_to_the_same_cutoff() -> None:
    assert nyquist_fraction(50.0, "hz", 124.98) == pytest.approx(0.80013, abs=1e-5)
    with pytest.raises(DataError):
        nyquist_fraction(50.0, "hz", 124.0)


def test_cutoff_in_hz_and_as_fraction_mean_the_same() -> None:
    data = raw(moving(1))
    in_hz = FilterSettings(unit="hz", velocity=7.5, acceleration=7.5, effort=10.0)
    for column in ("qd_f", "qdd_f", "effort_f"):
        assert prepare(data, in_hz)[column] == pytest.approx(prepare(data)[column], abs=1e-9)


def test_derivative_is_exact_for_a_parabola_on_uneven_stamps() -> None:
    t = np.cumsum(np.tile([0.010, 0.012, 0.034], 20))
    slope = derivative((3 * t**2 - t)[:, None], t)
    assert slope[1:-1, 0] == pytest.approx((6 * t - 1)[1:-1], rel=1e-9)


@pytest.mark.parametrize("t", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.0]])
def test_derivative_refuses_time_that_does_not_increase(t) -> None:
    with pytest.raises(DataError, match="time stamps"):
        derivative(np.zeros((len(t), 1)), np.array(t))


def test_sample_rate_of_alternating_stamps_is_the_mean_rate_without_pauses() -> None:
    steps = [0.010, 0.012] * 50
    t = np.cumsum([*steps, 5.0, *steps])
    assert sample_rate(t) == pytest.approx(1 / 0.011, rel=1e-3)


def test_prepare_follows_the_authors_recipe() -> None:
    t, q, qd, _ = fourier(3)
    rough = qd + 0.01 * np.random.default_rng(1).normal(size=qd.shape)
    data = dataset(
        {"t": t, "q": q, "qd": rough, "effort": rough}, [len(t)], [Conditions("a", "trajectory")]
    )
    slow, fast = butter(5, 0.15), butter(5, 0.20)
    velocity = filtfilt(*slow, rough, axis=0)
    expected = {
        "q_f": q,
        "qd_f": velocity,
        "qdd_f": filtfilt(*slow, np.gradient(velocity, t, axis=0), axis=0),
        "effort_f": filtfilt(*fast, rough, axis=0),
    }
    prepared = prepare(data)
    for column, values in expected.items():
        assert prepared[column] == pytest.approx(values, abs=1e-9), column


def test_series_are_filtered_apart() -> None:
    together = prepare(raw(moving(1, 2)))
    for seed, rows in ((1, slice(0, 600)), (2, slice(600, 1200))):
        alone = prepare(raw(moving(seed)))
        assert np.array_equal(together["qdd_f"][rows], alone["qdd_f"])


def test_missing_velocity_is_differentiated_from_position() -> None:
    data = raw(moving(1))
    without = Dataset(**{**vars(data), "columns": {k: data[k] for k in ("t", "q", "effort")}})
    assert prepare(without)["qd_f"][50:-50] == pytest.approx(data["qd"][50:-50], abs=5e-3)


def test_dwells_keep_their_effort_and_get_zero_velocity() -> None:
    columns = {"t": np.arange(10) * 0.008, "q": np.ones((10, 6)), "effort": np.ones((10, 6))}
    columns["qd"] = np.full((10, 6), 1e-3)
    prepared = prepare(dataset(columns, [10], [Conditions("a", "dwell")]))
    assert np.array_equal(prepared["effort_f"], columns["effort"])
    assert not prepared["qd_f"].any()
    assert not prepared["qdd_f"].any()


def test_series_too_short_for_the_filter_is_named() -> None:
    short = raw(moving(1, samples=18))
    with pytest.raises(DataError, match="series trajectory1: 18 samples are too few") as caught:
        prepare(short)
    assert "it needs 19" in caught.value.hint


def test_nan_is_refused_with_its_row_and_joint() -> None:
    data = raw(moving(1))
    effort = np.array(data["effort"])
    effort[41, 2] = np.nan
    with pytest.raises(DataError, match=r"1 values of effort .* row 42 joint 3"):
        prepare(data.with_columns(effort=effort))


def test_the_papers_filter_is_a_butterworth_at_50_hz_over_everything() -> None:
    t = np.arange(3000) / 1000.0
    rough = np.random.default_rng(2).normal(size=(3000, 6)).cumsum(axis=0)
    columns = {"t": t, "q": rough, "qd": rough[::-1], "effort": -rough}
    data = dataset(columns, [3000], [Conditions("a", "trajectory")])
    b, a = butter(5, 50.0, fs=1000.0)
    prepared = prepare(data, FilterSettings.model_validate("paper"))
    velocity = filtfilt(b, a, columns["qd"], axis=0)
    expected = {
        "q_f": filtfilt(b, a, rough, axis=0),
        "qd_f": velocity,
        "qdd_f": filtfilt(b, a, np.gradient(velocity, t, axis=0), axis=0),
        "effort_f": filtfilt(b, a, -rough, axis=0),
    }
    for column, values in expected.items():
        assert prepared[column] == pytest.approx(values, abs=1e-6 * np.ptp(values)), column


def test_keys_beside_a_preset_replace_its_values() -> None:
    given = FilterSettings.model_validate({"preset": "paper", "effort": 30})
    assert (given.unit, given.velocity, given.effort) == ("hz", 50.0, 30.0)
    assert FilterSettings.model_validate(given.model_dump()) == given


def test_the_papers_filter_is_refused_at_a_slow_rate_with_the_highest_cutoff() -> None:
    with pytest.raises(
        DataError, match=r"trajectory1: filters, velocity: .* 1 of the Ny"
    ) as caught:
        prepare(raw(moving(1)), FilterSettings.model_validate("paper"))
    assert "40 (hz)" in caught.value.hint


@pytest.mark.parametrize(("window", "degree"), [(5, 2), (9, 3), (21, 4)])
def test_local_slope_on_even_stamps_is_scipys_savitzky_golay(noise, window, degree) -> None:
    t = np.arange(300) * 0.008
    theirs = savgol_filter(noise, window, degree, deriv=1, delta=0.008, axis=0)
    assert polynomial_derivative(noise, t, window, degree) == pytest.approx(theirs, abs=1e-8)


def test_local_slope_of_a_cubic_is_exact_on_uneven_stamps_to_both_ends() -> None:
    t = np.cumsum(np.tile([0.010, 0.012], 40)) + 5e5
    x = t - t[0]
    slope = polynomial_derivative((4 * x**3 - x)[:, None], t, 7, 3)
    assert slope[:, 0] == pytest.approx(12 * x**2 - 1, abs=1e-6)


def test_local_slope_does_not_take_alternating_stamps_for_even_ones() -> None:
    t = np.cumsum(np.tile([0.010, 0.012], 300))
    wave, truth = np.sin(6 * t)[:, None], 6 * np.cos(6 * t)
    naive = savgol_filter(wave, 9, 3, deriv=1, delta=0.011, axis=0)[:, 0]
    ours = polynomial_derivative(wave, t, 9, 3)[:, 0]
    assert np.abs(ours - truth).max() < 0.01 < 0.1 < np.abs(naive - truth).max()


def test_local_slope_needs_as_many_samples_as_its_window() -> None:
    with pytest.raises(DataError, match="8 samples are too few for polynomials over 9"):
        polynomial_derivative(np.zeros((8, 1)), np.arange(8.0), 9, 3)


def test_savitzky_golay_and_velocity_from_position_reach_the_columns() -> None:
    data = raw(moving(1))
    given = FilterSettings(derivative="savitzky-golay", velocity_from="position")
    wrong = data.with_columns(qd=np.full_like(data["qd"], 7.0))
    velocity = filtfilt(*butter(5, 0.15), savgol_filter(data["q"], 9, 3, 1, 0.01, axis=0), axis=0)
    assert prepare(wrong, given)["qd_f"] == pytest.approx(velocity, abs=1e-8)


@pytest.mark.parametrize("given", [{"window": 8}, {"window": 3, "degree": 3}])
def test_windows_that_no_polynomial_fits_are_refused(given) -> None:
    with pytest.raises(ValidationError, match="odd and more than the degree"):
        FilterSettings(**given)


def test_downsampling_keeps_every_third_row_of_each_series_from_its_first() -> None:
    data = prepare(raw(moving(1, 2, samples=100)))
    fewer = downsample(data, FilterSettings(every=3))
    expected = [*range(0, 100, 3), *range(100, 200, 3)]
    assert np.array_equal(fewer["effort_f"], data["effort_f"][expected])
    assert fewer.offsets.tolist() == [0, 34, 68]


def test_a_rate_is_reached_as_nearly_as_whole_steps_allow() -> None:
    data = prepare(raw(moving(1)))
    assert downsampling_mask(data, FilterSettings(rate_hz=30.0)).sum() == 200
    assert downsample(data, FilterSettings()) is data


def test_dwells_keep_all_their_samples() -> None:
    columns = {name: np.ones((10, 6)) for name in ("q", "effort")} | {"t": np.arange(10) * 0.008}
    assert downsampling_mask(
        dataset(columns, [10], [Conditions("a", "dwell")]), FilterSettings(every=4)
    ).all()


def test_samples_too_few_for_what_the_filters_pass_are_refused_with_the_most_that_can_go() -> None:
    with pytest.raises(DataError, match="series trajectory1: one sample in 5") as caught:
        downsample(prepare(raw(moving(1))), FilterSettings(every=5))
    assert "every: 4" in caught.value.hint


def test_every_and_rate_together_are_refused() -> None:
    with pytest.raises(ValidationError, match="both set the down-sampling"):
        FilterSettings(every=2, rate_hz=50.0)


def test_columns_are_filtered_as_their_effort_and_rest_stays() -> None:
    t = fourier(3)[0]
    times = np.concatenate([t, t[-1] + 1 + np.arange(10) * 0.01])
    values = np.random.default_rng(0).normal(size=(len(times), 2, 3))
    rows = np.zeros((len(times), 6))
    data = dataset(
        {"t": times, "q": rows, "effort": rows},
        [len(t), 10],
        [Conditions("a", "trajectory"), Conditions("b", "dwell")],
    )
    filtered = filter_columns(values, data, FilterSettings(effort=0.3))
    expected = filtfilt(*butter(5, 0.3), values[: len(t)], axis=0)
    assert filtered[: len(t)] == pytest.approx(expected, abs=1e-8)
    assert np.array_equal(filtered[len(t) :], values[len(t) :])


def test_columns_of_fewer_rows_are_filtered_at_the_same_frequency() -> None:
    data = raw(moving(1))
    settings = FilterSettings(effort=0.1, every=4)
    whole = filter_columns(data["qd"], data, settings)
    fewer = downsample(prepare(data, settings), settings)
    again = filter_columns(fewer["qd"], fewer, settings)
    assert again[20:-20] == pytest.approx(whole[::4][20:-20], abs=2e-3)
