"""The interlocks of a run, as previews, first attempts and resumed attempts make them.

They are made once and early, so that one that cannot be judged on this robot is refused before a
motion has to be confirmed. Folder and recorder of the run, which two of them watch, come later.
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
    """The interlocks that the spec of a run asks for; nothing is started.

    Args:
        experiment: The spec and the station.
        robot: Opened.
        plan: Says which loads will be mounted.

    Attributes:
        all: Every interlock, with those that are not watched and why. To be closed if an engine
            has judged them.

    Raises:
        PlanError: An interlock of the spec cannot be judged on this robot; all are listed.
        PluginError: A plug-in does not load.
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
        """Watch the disk of a run directory and the backlog of its recorder from now on."""
        self._recorded = folder, recorder

    def _recording(self) -> tuple[Path, Recorder]:
        if self._recorded is None:
            raise RuntimeError("interlocks are judged before the recording has begun")
        return self._recorded
