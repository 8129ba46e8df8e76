"""Friction columns are filtered where the effort was, before rows are left out."""

import numpy as np
import pytest

from hil.estimators import estimator
from tests.support.synthetic_motion import moving, nominal, raw


@pytest.mark.parametrize("filters", [{}, {"unit": "hz", "velocity": 10, "effort": 3}])
def test_columns_of_fewer_rows_are_rows_of_the_same_columns(filters) -> None:
    data = raw(moving(1, 2))
    model = estimator("rigid-linear", filters={"every": 3, **filters}).fit(data, nominal())
    every = estimator("rigid-linear", filters=filters).fit(data, nominal())
    kept = model._training_rows(data)
    whole = every._training_rows(data)
    rows = np.isin(whole["t"], kept["t"])
    for name, term in model._friction_terms(kept).items():
        assert np.array_equal(term, every._friction_terms(whole)[name][rows])
