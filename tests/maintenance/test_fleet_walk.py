"""The simulated fleet from its first day to a report years later, by the how-to's commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.fleet_parts import FITTED, SPEC
from tests.support.fleet_walk import walked

WORN = ("ur5-017", 1)
PROBE = SPEC.replace("fundamental_hz: 0.5, seed: 3", "fundamental_hz: 0.2, seed: 21")
PROBE = PROBE.replace("trajectories: 1", "trajectories: 4")


@pytest.mark.wire
@pytest.mark.timeout(300)  # four runs, three pools of processes
def test_two_robots_of_the_simulated_fleet_from_new_to_a_report(tmp_path: Path) -> None:
    first, probe = tmp_path / "first.yaml", tmp_path / "probe.yaml"
    first.write_text(FITTED, "utf-8")
    probe.write_text(PROBE, "utf-8")
    fits, probes, report = walked(tmp_path, ["ur5-01[67]"], first, probe)
    assert [(one["robot"], one["role"]) for one in fits] == [
        ("ur5-016", "champion"), ("ur5-017", "champion"),
    ]  # fmt: skip
    assert [one["robot"] for one in probes] == ["ur5-016", "ur5-017"]
    assert not any(one["error"] for one in probes)
    change = np.array([one["change"] for one in report["robots"]])
    assert np.unravel_index(np.argmax(change), change.shape) == (1, WORN[1])
    assert change[1, WORN[1]] > 1.2
    assert all(one["age_years"] > 1 for one in report["robots"])
    assert report["friction"] is None  # two are no fleet
