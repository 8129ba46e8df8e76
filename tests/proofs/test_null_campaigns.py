"""A robot that never changes, identified anew every week: it keeps its model.

On the data of one day almost every challenger errs less for sure: it was fitted in that day's room.
"""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from hil.maintenance.simulation import simulate
from hil.spec.schedule import load_schedule_spec
from tests.support.pipeline_parts import SCHEDULE

pytestmark = [pytest.mark.proof, pytest.mark.timeout(1200)]

SEEDS, WEEKS = (511, 512, 513), 9
FOURIER = {
    "kind": "fourier", "harmonics": 5, "fundamental_hz": 0.1,
    "max_velocity_deg_s": 100, "max_acceleration_deg_s2": 300,
}  # fmt: skip
SHORT: dict[str, Any] = {"hil": 1, "robot": "ur5", "warm_up": {"duration_s": 0}}
FILES: dict[str, dict[str, Any]] = {
    "probe": SHORT | {"name": "probe", "excitation": FOURIER | {"seed": 21, "trajectories": 3}},
    "campaign": SHORT | {
        "name": "campaign",
        "excitation": FOURIER | {"seed": 7, "trajectories": 8},
        "fit": [{"estimator": "rigid-wls"}],
        "validate": {"hold_out": {"trajectories": 2}},
    },
}  # fmt: skip


@pytest.mark.parametrize("seed", SEEDS)
def test_a_robot_that_has_not_changed_keeps_its_champion(tmp_path: Path, seed: int) -> None:
    robots = {"ur5": {"driver": "mock", "model": "ur5", "options": {"seed": seed}}}
    weekly = SCHEDULE | {
        "start": "2026-11-28T03:00",
        "campaign": {"spec": "campaign.yaml", "every": "7d"},
        "simulate": {"room_c": [14, 30], "seed": seed},
    }
    files = FILES | {"station": {"hil_station": 1, "robots": robots}, "weekly": weekly}
    for name, content in files.items():
        (tmp_path / f"{name}.yaml").write_text(json.dumps(content), "utf-8")
    spec = load_schedule_spec(tmp_path / "weekly.yaml")
    told = simulate(spec, timedelta(weeks=WEEKS), tmp_path / "out")
    results = [each["result"] for each in told["occasions"]]
    assert len(results) == WEEKS + 1
    assert results[0]["outcome"] == "promoted"
    better = [r["decision"]["evidence"]["comparison"]["better"] for r in results[1:]]
    promoted = [week for week, r in enumerate(results) if r["outcome"] == "promoted"]
    print(f"seed {seed}: on its day {sum(better)} of {WEEKS} err less, promoted in {promoted}")  # noqa: T201
    assert sum(better) > WEEKS / 2
    # The first repetition knows of no day before it.
    assert set(promoted) <= {0, 1}
