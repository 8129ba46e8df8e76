"""A kill -9 anywhere in a recovery leaves the old state or the new one; again ends in the new."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from hil.recording import read_topic
from tests.support.paths import FILES
from tests.support.recorded_rows import record_state

SCRIPT = FILES / "kill_recover.py"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["00.mcap.partial", "00.mcap"])
@pytest.mark.parametrize("discard", [False, True])
def test_a_kill_at_any_step_leaves_the_old_or_the_new_state(
    tmp_path: Path, name: str, discard: bool
) -> None:
    torn = tmp_path / name
    record_state(tmp_path / "whole.mcap", 100)
    torn.write_bytes((tmp_path / "whole.mcap").read_bytes()[:-3000])
    rows = read_topic(torn, salvage=True).tobytes()
    whole = f"{len(rows) // 416} rows {hashlib.sha256(rows).hexdigest()}"
    original = hashlib.sha256(torn.read_bytes()).hexdigest()

    command = [sys.executable, str(SCRIPT), str(torn), str(tmp_path / "work")]
    command += ["--discard"] if discard else []
    done = subprocess.run(command, capture_output=True, text=True, check=True)

    new, aside = {"00.mcap": whole}, {"00.mcap.torn": original}
    kept = new if discard else new | aside
    # A torn file of another name stands beside the new one for a moment; one that has the final
    # name already has its second name before it loses the first.
    between = {name: original} | (aside if name == "00.mcap" else new)
    allowed = [{name: original}, between, new | aside, kept]
    steps = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(steps) > 12
    for step in steps:
        assert step["dead"] in allowed, step
        assert step["after"] == kept, step
        assert step["drafts"] == [], step
