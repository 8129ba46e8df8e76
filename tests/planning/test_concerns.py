"""What `hil plan` warns of, and what it does not."""

from __future__ import annotations

import math

import pytest

from hil.planning.plan_preview import concerns


def test_an_ordinary_plan_raises_no_concern() -> None:
    assert list(concerns(20.0, 3600.0, 1e8)) == []


@pytest.mark.parametrize(
    ("condition", "duration_s", "size", "word"),
    [
        (1001.0, 1.0, 1.0, "the condition number is 1001, above 1000"),
        (math.inf, 1.0, 1.0, "infinite condition number"),
        (2.0, 12.5 * 3600, 1.0, "12.5 h, more than 12 h"),
        (2.0, 1.0, 21e9, "21 GB, more than 20 GB"),
    ],
)
def test_each_concern_is_told_with_its_figure(
    condition: float, duration_s: float, size: float, word: str
) -> None:
    (told,) = concerns(condition, duration_s, size)
    assert word in told
