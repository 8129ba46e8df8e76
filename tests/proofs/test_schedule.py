"""The loop, killed again and again; and any course of events, accounted for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.schedule_killing import killed_at_random
from tests.support.schedule_parts import anything_may_happen

pytestmark = [pytest.mark.proof, pytest.mark.timeout(1200)]


def test_sixty_kills_lose_nothing_and_repeat_nothing(tmp_path: Path) -> None:
    ledger = killed_at_random(tmp_path, 60, seed=11)
    assert sum(bool(line.get("again")) for line in ledger.lines) >= 20


def test_forty_courses_of_events_are_accounted_for() -> None:
    for seed in range(40):
        anything_may_happen(seed, ("run", "skip")[seed % 2], parts=8, hours=40)
