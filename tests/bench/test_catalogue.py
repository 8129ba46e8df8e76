"""`hil bench catalogue` runs, and the catalogue says what the directories say."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure


@pytest.mark.thorough
def test_the_catalogue_and_the_directories_say_the_same() -> None:
    document = measure("catalogue", quick=True)
    assert document["figures"]["runs"] == 60
    assert 0 < document["figures"]["found"] < 60
    assert document["ratios"]["query_vs_reading"] > 1.0
