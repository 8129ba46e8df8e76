"""Judging every sample costs little: the benchmark, on its smaller problem."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure


@pytest.mark.thorough
def test_the_default_set_is_far_cheaper_than_computing_every_sample() -> None:
    measured = measure("interlocks", quick=True)
    assert measured["figures"]["computed_percent"] < 15
    assert measured["ratios"]["blocks_of_1"] > 4
    assert measured["ratios"]["blocks_of_16"] > 15
    assert measured["ratios"]["coal_vs_numpy_one_sample"] > 3
