"""Quantiles and tails are those of `scipy.stats`, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from hil.estimators.distributions import (
    fisher_tail,
    normal_quantile,
    student_quantile,
    student_tail,
)

PROBABILITIES = np.array([1e-300, 1e-9, 0.025, 0.5, 0.975, 1.0 - 1e-9, 1.0])


@pytest.mark.parametrize("degrees", [0.5, 1.0, 5.0, 37.2, 1e6, np.inf])
def test_students_t(degrees: float) -> None:
    found = student_quantile(PROBABILITIES, degrees)
    np.testing.assert_array_equal(found, stats.t.ppf(PROBABILITIES, degrees))
    np.testing.assert_array_equal(-found, stats.t.isf(PROBABILITIES, degrees))
    values = np.array([-np.inf, -3.0, 0.0, 1e-9, 2.0, 1e10, np.inf, np.nan])
    np.testing.assert_array_equal(student_tail(values, degrees), stats.t.sf(values, degrees))


def test_normal() -> None:
    np.testing.assert_array_equal(-normal_quantile(PROBABILITIES), stats.norm.isf(PROBABILITIES))


@pytest.mark.parametrize("ratio", [-1e-12, 0.0, 0.3, 1.0, 5.0, np.inf, np.nan])
def test_fishers_f(ratio: float) -> None:
    assert fisher_tail(ratio, 3, 20.0) == pytest.approx(
        stats.f.sf(ratio, 3, 20.0), rel=0, abs=0, nan_ok=True
    )
