"""An excitation: home, and each joint moved a little from there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.excitation import Program, Roadmap, pose_visit


class Nudge:
    """As many poses as `waypoints` says, the first one at home."""

    def __init__(self, spec: Any, folder: Path = Path()) -> None:
        self.spec = spec

    def program(self, roadmap: Roadmap) -> Program:
        visits = []
        for pose in range(self.spec.waypoints):
            q = np.array(roadmap.home, dtype=float)
            q[pose % len(q)] += 0.05 * (pose > 0)
            visits.append(
                pose_visit(roadmap.workspace, q, "free", 0.05, label=f"nudge {pose}", pose=pose)
            )
        return Program(visits)
