"""Runs of a fleet as probes, each against its robot's champion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import HilError
from hil.models import FleetFolder, Probe, Registry, assess, completed, robot_of


@dataclass(frozen=True, slots=True, eq=False)
class Probed:
    """What was said of one robot.

    Attributes:
        robot: Its name.
        asked: False-alarm rate that was asked for it, so that the fleet's is as stated.
        probe: None where it could not be judged.
        error: Why not, else empty.
    """

    robot: str
    asked: float
    probe: Probe | None = None
    error: str = ""

    @property
    def note(self) -> str:
        """What is to be known of the judgement: it may be one that was made before."""
        if self.probe is None or math.isclose(self.probe.false_alarm, self.asked, rel_tol=1e-9):
            return ""
        return f"judged before, at a rate of {self.probe.false_alarm:.2g}, not {self.asked:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """An entry of `hil fleet drift --json`."""
        told = {} if self.probe is None else self.probe.to_dict()
        more = {"asked": self.asked, "note": self.note or None, "error": self.error or None}
        return {"robot": self.robot, **told, **more}


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[Probed]:
    """Judge the runs of a fleet as probes; one that cannot be judged leaves the others alone.

    Args:
        path: Folder of the fleet.
        registry: With champions of the robots.
        false_alarm: Probability with which any of the robots is called changed though none is:
            nominally, of probes that are judged now and know nothing of one another.

    Raises:
        DataError: It is no fleet.
    """
    runs = completed(FleetFolder.open(path)[1])
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, len(runs)))
    return [_probed(registry, run, each) for run in runs]


def _probed(registry: Registry, run: Path, false_alarm: float) -> Probed:
    robot = robot_of(run)
    try:
        return Probed(robot, false_alarm, assess(registry, robot, run, false_alarm=false_alarm))
    except HilError as error:
        return Probed(robot, false_alarm, error=error.message)
