"""The interlocks of an experiment: what its spec asks for, its station and its robot."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from hil.arms import is_described, load_arm
from hil.dynamics import SampleDistances
from hil.engine import InterlockContext, Interlocks, interlocks_from_spec
from hil.planning import Experiment, Plan, collision_model, flange_space
from hil.robot import HasSpeedScaling, Robot


def interlocks_for(
    experiment: Experiment,
    robot: Robot,
    plan: Plan,
    *,
    folder: Path | None = None,
    behind_s: Callable[[], float] | None = None,
) -> Interlocks:
    """What will watch over a run; nothing is started. Close them after it.

    Args:
        experiment: The spec and the station.
        robot: Connected.
        plan: Says which loads will be mounted.
        folder: Where is recorded; None when nothing is.
        behind_s: How far writing is behind reading [s]; None without a recorder.

    Raises:
        PlanError: An interlock of the spec cannot be judged on this robot; all are listed.
        PluginError: A plug-in does not load.
    """
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
        behind_s=behind_s,
        folder=folder,
        speed_scaling=(lambda: robot.speed_scaling) if isinstance(robot, HasSpeedScaling) else None,
        clock=can.clock,
    )
    return interlocks_from_spec(experiment.spec.interlocks, context)
