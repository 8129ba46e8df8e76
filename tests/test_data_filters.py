import numpy as np
import pytest
from scipy.signal import butter, filtfilt
from synthetic_motion import dataset, fourier, moving, raw

from hil.data import Conditions, Dataset
from hil.data.filters import (
    FilterSettings,
    derivative,
    nyquist_fraction,
    prepare,
    sample_rate,
    zero_phase,
)
from hil.errors import DataError


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
