"""Assessment of fleet runs as drift probes, each against the champion of its robot.

The false-alarm rate of each robot is chosen so that the whole fleet has the requested rate.
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
    """Probe of one robot of a fleet.

    Attributes:
        robot: Name of the robot.
        required_rate: False-alarm rate per robot with which the whole fleet has the requested rate.
        probe: Result of the robot's probe; None if the robot could not be assessed.
        error: Reason why the robot could not be assessed; empty if it was assessed.
    """

    robot: str
    required_rate: float
    probe: Probe | None = None
    error: str = ""

    @property
    def note(self) -> str:
        """Note about an earlier assessment at a different false-alarm rate; empty for none."""
        if self.probe is None:
            return ""
        rate, required = self.probe.false_alarm, self.required_rate
        if math.isclose(rate, required, rel_tol=1e-9):
            return ""
        return f"evaluated earlier, at a rate of {rate:.2g}, not {required:.2g}"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of this robot in `hil fleet drift --json`."""
        probe = {} if self.probe is None else self.probe.to_dict()
        more = {
            "asked": self.required_rate,
            "note": self.note or None,
            "error": self.error or None,
        }
        return {"robot": self.robot, **probe, **more}


def probe_fleet(path: Path, registry: Registry, false_alarm: float) -> list[RobotProbe]:
    """Assess the runs of a fleet as probes; the error of one run does not stop the others.

    Args:
        path: Folder of the fleet.
        registry: Registry with the champions of the robots.
        false_alarm: Probability of at least one detected change in the fleet if no robot has
            changed. The probability of a false alarm is exact only for independent probes that are
            assessed in this call.

    Raises:
        DataError: The folder is not a fleet.
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
