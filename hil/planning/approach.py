"""The way back to a plan from wherever the arm stands; for resuming a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import load_arm
from hil.core import FloatArray, PlanError
from hil.excitation import Line
from hil.planning.place import checked_start, roadmap_of, workspace_of
from hil.spec import ExperimentSpec, StationRobot


class Approach:
    """Finds ways in the workspace of an experiment, within its speeds and clearances.

    Args:
        spec: The experiment.
        station_robot: Its robot and what stands around it.
        rate_hz: The plan's rate.
        here: (n,) where the arm stands [rad].
        targets: (k, n) poses of the plan, where it may go on [rad].

    Raises:
        PlanError: The arm cannot leave that pose safely.
    """

    def __init__(
        self,
        spec: ExperimentSpec,
        station_robot: StationRobot,
        *,
        rate_hz: float,
        here: FloatArray,
        targets: FloatArray,
    ) -> None:
        arm = load_arm(station_robot.model)
        workspace = workspace_of(spec, station_robot, arm, rate_hz)
        self._roadmap = roadmap_of(workspace, wanted=targets, start=here)
        checked_start(here, self._roadmap)

    def way(self, here: FloatArray, target: FloatArray) -> Sequence[Line]:
        """Clear lines from one joint position (n,) to another [rad].

        Raises:
            PlanError: There are none.
        """
        lines = self._roadmap.way(here, target)
        if lines is None:
            raise PlanError(
                f"no clear path leads from {_degrees(here)} to {_degrees(target)}",
                hint="jog the robot to a pose with more room around it and resume from there",
            )
        return lines


def _degrees(q: FloatArray) -> str:
    return f"({', '.join(f'{angle:.1f}' for angle in np.degrees(q))})°"
