"""Recordings of a UR5 as a lab has them: a CSV file, imported with a map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.arms.payload import Payload
from hil.importers import ImportMap, import_recording
from tests.support.synthetic_motion import GAINS, fourier, nominal, true_torque


def layout(**changes: Any) -> ImportMap:
    """The map of `recording`, with changes."""
    columns = {
        "t": {"columns": 1},
        "q": {"columns": "2:7", "unit": "rad"},
        "qd": {"columns": "8:13", "unit": "rad/s"},
        "effort": {"columns": "14:19", "unit": "A"},
    }
    return ImportMap.model_validate(
        {
            "hil_map": 1,
            "format": "csv",
            "robot": "ur5",
            "joint_names": nominal().joint_names,
            "effort_kind": "current",
            "drive_gains_nm_a": GAINS.tolist(),
            "columns": columns,
        }
        | changes
    )


def recording(
    folder: Path,
    seed: int,
    *,
    load: Payload | None = None,
    name: str = "",
    late_s: float = 0.0,
    **changes: Any,
) -> Path:
    """Ten seconds of motion in `folder`: NAME.csv, and what is returned, NAME.mcap."""
    t, q, qd, qdd = fourier(seed, 1000)
    current = true_torque(q, qd, qdd, load) / GAINS
    if changes.get("effort_kind") == "torque":
        columns = layout().columns.model_dump()
        columns["effort"]["unit"] = "N·m"
        changes |= {"columns": columns, "drive_gains_nm_a": None}
    path = folder / f"{name or seed}.csv"
    table = np.column_stack([t + late_s, q, qd, current])
    np.savetxt(path, table, delimiter=",", fmt="%.12g")
    out = path.with_suffix(".mcap")
    import_recording(path, map_file=layout(**changes), out=out)
    return out
