"""Thirty robots of the simulated fleet, new and aged: who is worn stands out, and nobody else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.fleet_walk import EXPERIMENTS, walked

ROBOTS = ("ur5-01?", "ur5-04?", "ur5-08?")
WORN = {
    ("ur5-017", "shoulder_lift_joint"),
    ("ur5-048", "elbow_joint"),
    ("ur5-083", "wrist_2_joint"),
}


@pytest.mark.proof
@pytest.mark.timeout(3600)
def test_the_three_worn_robots_stand_out_by_their_change_and_age_is_found(tmp_path: Path) -> None:
    first, probe = EXPERIMENTS / "fleet_fourier.yaml", EXPERIMENTS / "ur5_probe.yaml"
    fits, probes, report = walked(tmp_path, ROBOTS, first, probe)
    assert len(fits) == len(probes) == 30
    assert {(one["role"], one["passed"], one["verdict"]) for one in fits} == {
        ("champion", True, "passed")
    }
    assert not any(one["error"] for one in probes)
    out = report["change"]["outliers"]
    assert {(one["robot"], one["joint"]) for one in out} == WORN
    assert report["friction"]["outliers"] == []
    slopes = np.array(report["change"]["slopes"]["age"]["share"])
    assert np.all((slopes > 0.01) & (slopes < 0.025))  # 2 % of the new robot's, simulated
