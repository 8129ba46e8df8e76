import numpy as np
import pytest

from hil.data.metrics import correlation, mep, nrmse, rmse

MEASURED = np.array([[1.0, 0.0], [-1.0, 0.0], [3.0, 0.0], [-3.0, 0.0]])
PREDICTED = np.array([[1.0, 0.0], [-2.0, 0.0], [3.0, 0.0], [-1.0, 0.0]])


def test_rmse_per_joint() -> None:
    assert rmse(MEASURED, PREDICTED) == pytest.approx([np.sqrt(5 / 4), 0.0])


def test_nrmse_is_over_the_signals_own_deviation_or_a_given_one() -> None:
    assert nrmse(MEASURED, PREDICTED)[0] == pytest.approx(np.sqrt(5 / 4) / np.sqrt(5))
    assert nrmse(MEASURED, PREDICTED, np.array([2.0, 1.0])) == pytest.approx(
        [np.sqrt(5 / 4) / 2, 0.0]
    )


def test_predicting_the_mean_has_nrmse_one() -> None:
    signal = np.random.default_rng(0).normal(size=(100, 3))
    assert nrmse(signal, np.broadcast_to(signal.mean(axis=0), signal.shape)) == pytest.approx(1.0)


def test_mep_is_the_largest_error_in_per_cent_of_the_largest_value() -> None:
    assert mep(MEASURED, PREDICTED)[0] == pytest.approx(100 * 2 / 3)


def test_correlation_is_pearsons() -> None:
    random = np.random.default_rng(0)
    a = random.normal(size=(50, 3))
    b = a + random.normal(size=(50, 3))
    expected = [np.corrcoef(a[:, j], b[:, j])[0, 1] for j in range(3)]
    assert correlation(a, b) == pytest.approx(expected)


def test_joint_without_signal_has_no_relative_error() -> None:
    for metric in (nrmse, mep, correlation):
        assert np.isnan(metric(MEASURED, PREDICTED)[1])


@pytest.mark.parametrize("metric", [rmse, nrmse, mep, correlation])
def test_no_rows_give_nan(metric) -> None:
    empty = np.empty((0, 2))
    assert np.isnan(metric(empty, empty)).all()
