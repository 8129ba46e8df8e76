"""kill -9 at random moments of the loop: what is due is done once, or it is said why not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.schedule_killing import killed_at_random

KILLS = 5


@pytest.mark.thorough
def test_a_kill_loses_nothing_and_repeats_nothing(tmp_path: Path) -> None:
    killed_at_random(tmp_path, KILLS, seed=3)
