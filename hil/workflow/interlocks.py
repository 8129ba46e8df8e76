"""Construction of a run's interlocks, for previews, first attempts and resumed attempts.

The interlocks are created early, so that an interlock that cannot be evaluated on the robot is
reported before the operator has to confirm a motion. Two of the interlocks observe the folder and
the recorder of the run, which do not exist yet and are assigned later.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hil.arms import is_described, load_arm
from hil.dynamics import SampleDistances
from hil.engine import InterlockContext, interlocks_from_spec
from hil.planning import Experiment, Plan, collision_model, flange_space
from hil.recording import Recorder
from hil.robot import HasSpeedScaling, Robot


class RunInterlocks:
    """Interlocks that the spec of a run requires; their creation does not start the monitoring.

    Args:
        experiment: Experiment with spec and station.
        robot: Opened robot.
        plan: Plan, which determines the loads that will be mounted.

    Attributes:
        all: List of all interlocks, including unmonitored interlocks with the reason. The
            collection of interlocks has to be closed after an engine has used it.

    Raises:
        PlanError: Interlocks of the spec cannot be evaluated on this robot; the message lists all
            such interlocks.
        PluginError: The plug-in of an interlock cannot be loaded.
    """

    def __init__(self, experiment: Experiment, robot: Robot, plan: Plan) -> None:
        can, surroundings = robot.capabilities, experiment.robot.surroundings
        sizes = [load.size_m for load in plan.loads]
        arm = load_arm(plan.robot_model) if is_described(plan.robot_model) else None
        loads = [(load.payload, load.size_m) for load in plan.loads]
        context = InterlockContext(
            joint_names=can.joint_names,
            effort_kind=can.effort_kind,
            drive_gains=can.drive_gains,
            effort_max=tuple(map(float, robot.limits.effort_max)),
            clearance=SampleDistances(collision_model(arm, surroundings, loads)) if arm else None,
            clearance_m=surroundings.clearance_m,
            flange=partial(flange_space, arm, sizes=sizes) if arm else None,
            behind_s=lambda: self._recording()[1].behind_s,
            folder=lambda: self._recording()[0],
            speed_scaling=(
                (lambda: robot.speed_scaling) if isinstance(robot, HasSpeedScaling) else None
            ),
            clock=can.clock,
        )
        self._recorded: tuple[Path, Recorder] | None = None
        self.all = interlocks_from_spec(experiment.spec.interlocks, context)

    def watch_recording(self, folder: Path, recorder: Recorder) -> None:
        """Monitor the disk of a run directory and the backlog of its recorder from now on."""
        self._recorded = folder, recorder

    def _recording(self) -> tuple[Path, Recorder]:
        if self._recorded is None:
            raise RuntimeError("interlocks were evaluated before the recording began")
        return self._recorded
