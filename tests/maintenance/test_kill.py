"""Killed at random points, loop, pipeline and registry repeat nothing and lose nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.pipeline_deaths import died, require_accounted, require_once


@pytest.mark.thorough
@pytest.mark.timeout(240)
def test_a_schedule_that_is_killed_again_and_again_does_everything_once(tmp_path: Path) -> None:
    lives = died(tmp_path, seed=4, lives=6)
    told = require_once(tmp_path)
    require_accounted(tmp_path)
    assert lives > 2
    assert told["outcome"] == "promoted", told["text"]
