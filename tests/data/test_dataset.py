"""What a dataset refuses to be."""

from __future__ import annotations

import pytest

from hil.core.errors import DataError
from tests.support.synthetic_motion import moving


@pytest.mark.parametrize("column", ["q", "qd", "effort", "q_f"])
@pytest.mark.parametrize("shape", ["narrow", "flat"])
def test_columns_of_another_width_are_no_dataset(column: str, shape: str) -> None:
    values = moving(9)[column]
    with pytest.raises(DataError, match=rf"column {column} .* not \(600, 6\)") as caught:
        moving(9).with_columns(**{column: values[:, :5] if shape == "narrow" else values[:, 0]})
    assert caught.value.hint
