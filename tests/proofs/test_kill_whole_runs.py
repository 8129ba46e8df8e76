"""Whole runs, registrations, promotions and steps of a schedule, killed at random moments."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.proof, pytest.mark.timeout(3600)]

SCRIPT = Path(__file__).with_name("kill_whole_runs.py")
KILLS = 40


def test_a_kill_at_any_moment_loses_nothing_and_the_next_command_is_named() -> None:
    command = [sys.executable, str(SCRIPT), "--kills", str(KILLS), "--seed", "1"]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    print(told.stdout)  # noqa: T201
    assert told.returncode == 0, told.stdout[-2000:] + told.stderr[-2000:]
    assert f"{KILLS} kills" in told.stdout
