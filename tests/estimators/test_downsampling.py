"""Fits on fewer rows than were recorded."""

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.estimators import estimator
from tests.support.synthetic_motion import moving, nominal, raw


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rigid-wls", "rigid-linear"])
def test_a_fit_uses_every_fourth_row_and_predicts_all_of_them(name) -> None:
    data = raw(moving(1, 2, 3))
    whole = estimator(name).fit(data, nominal())
    fewer = estimator(name, filters={"every": 4}).fit(data, nominal())
    assert (whole.samples_, fewer.samples_) == (1800, 450)
    assert len(fewer.predict(data).effort) == 1800
    difference = fewer.predict(data).effort - whole.predict(data).effort
    assert np.sqrt(np.mean(difference**2, axis=0)) == pytest.approx(0.0, abs=0.02)


def test_standard_errors_do_not_grow_with_rows_that_said_nothing_new() -> None:
    data = raw(moving(1, 2, 3))
    noise = np.random.default_rng(0).normal(scale=0.1, size=data["effort"].shape)
    noisy = data.with_columns(effort=data["effort"] + noise)
    whole = estimator("rigid-wls").fit(noisy, nominal())
    fewer = estimator("rigid-wls", filters={"every": 4}).fit(noisy, nominal())
    assert np.median(fewer.std_error_ / whole.std_error_) == pytest.approx(1.0, abs=0.25)


def test_a_fit_says_when_its_rows_are_too_few_for_its_filters() -> None:
    with pytest.raises(DataError, match="too few for signals filtered at 10 Hz"):
        estimator("rigid-wls", filters={"rate_hz": 10.0}).fit(raw(moving(1, 2)), nominal())


def test_the_papers_filters_are_a_word_in_a_spec() -> None:
    assert estimator("rigid-wls", filters="paper").get_params()["filters"].effort == 50.0
