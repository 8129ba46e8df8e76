"""A schedule of an embedded mock whose runs take seconds of motion and less of computing."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hil.maintenance.ledger import Job, Occasion

FOURIER = {
    "kind": "fourier", "harmonics": 3, "fundamental_hz": 0.2,
    "max_velocity_deg_s": 100, "max_acceleration_deg_s2": 300,
}  # fmt: skip
SHORT: dict[str, Any] = {"hil": 1, "robot": "ur5", "warm_up": {"duration_s": 0}}
PROBE = SHORT | {"name": "probe", "excitation": FOURIER | {"seed": 21, "trajectories": 4}}
CAMPAIGN = SHORT | {
    "name": "campaign",
    "excitation": FOURIER | {"seed": 7, "trajectories": 5},
    "fit": [{"estimator": "rigid-wls"}],
    "validate": {"hold_out": {"trajectories": 1}},
}
SCHEDULE: dict[str, Any] = {
    "hil_schedule": 1,
    "name": "weekly",
    "probe": {"spec": "probe.yaml", "every": "7d"},
    "campaign": {"spec": "campaign.yaml"},
}


def write_schedule(
    folder: Path, probe: Any = PROBE, campaign: Any = CAMPAIGN, schedule: Any = SCHEDULE
) -> Path:
    """The schedule's file; YAML is JSON and more."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("probe", probe), ("campaign", campaign), ("weekly", schedule)):
        (folder / f"{name}.yaml").write_text(json.dumps(content, indent=1), "utf-8")
    return folder / "weekly.yaml"


def occasion(week: int, job: Job = "probe") -> Occasion:
    """Of a Saturday night in January 2027."""
    return Occasion(datetime(2027, 1, 2 + 7 * week, 3, tzinfo=UTC), job)
