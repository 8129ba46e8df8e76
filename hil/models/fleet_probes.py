"""The runs of a fleet judged as probes, each against its robot's champion.

Each robot is judged at such a rate of false alarms that the whole fleet has the requested rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import HilError
from hil.models.drift import Probe, assess
from hil.models.fleet_fits import robot_of
from hil.models.model_registry import Registry
from hil.recording import FleetGroup


@dataclass(frozen=True, slots=True, eq=False)
class RobotProbe:
    """The probe of one robot of a fleet.

    Attributes:
        robot: Its name.
        required_rate: Per-robot false-alarm rate that gives the fleet the requested rate.
        probe: None if the robot could not be judged.
        error: Why not, else empty.
    """

    robot: str
    required_rate: float
    probe: Probe | None = None
    error: str = ""

    @property
    def note(self) -> str:
        """A note if the probe was judged earlier, at another rate of false alarms; else empty."""
        if self.probe is None:
            return ""
        rate, required = self.probe.false_alarm, self.required_rate
        if math.isclose(rate, required, rel_tol=1e-9):
            return ""
        return f"judged before, at a rate of {rate:.2g}, not {required:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `hil fleet drift --json`."""
        probe = {} if self.probe is None else self.probe.to_dict()
        more = {
            "asked": self.required_rate,
            "note": self.note or None,
            "error": self.error or None,
        }
        return {"robot": self.robot, **probe, **more}


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[RobotProbe]:
    """Judge the runs of a fleet as probes; one that cannot be judged does not stop the others.

    Args:
        path: Folder of the fleet.
        registry: Holds the champions of the robots.
        false_alarm: Probability that at least one robot is called changed although none is; exact
            only for independent probes that are judged in this call.

    Raises:
        DataError: It is no fleet.
    """
    runs = FleetGroup.open(path).completed()
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(1, len(runs)))
    return [_probe_robot(registry, run, each) for run in runs]


def _probe_robot(registry: Registry, run: Path, false_alarm: float) -> RobotProbe:
    robot = robot_of(run)
    try:
        return RobotProbe(robot, false_alarm, assess(registry, robot, run, false_alarm=false_alarm))
    except HilError as error:
        return RobotProbe(robot, false_alarm, error=error.message)
