"""Where a spec's robot may be: its arm, its workspace, and the ways through it."""

from __future__ import annotations

import numpy as np

from hil.arms import ArmDescription, arm_names, is_described, load_arm
from hil.errors import PlanError
from hil.excite.poses import roomy_poses
from hil.excite.roadmap import Roadmap
from hil.excite.workspace import Workspace
from hil.plan.interlocks import declared_space
from hil.plan.limits import draw_range
from hil.plan.quality import condition_score
from hil.plan.surroundings import collision_model
from hil.spec.experiment import Dwell, ExperimentSpec
from hil.spec.station import StationRobot
from hil.typing import FloatArray

ROADMAP_POSES = 48
CONFINED_ROADMAP_POSES = 96
"""Where the flange is confined fewer straight lines are clear: below a height of 0.5 m 48 poses
connect 37 % of the clear ones of a UR5, 96 connect 50 %, and 144 no more."""

ROADMAP_SEED = 0


def plannable_arm(station_robot: StationRobot) -> ArmDescription:
    """The arm of a station's robot, once it is known that motions can be planned for it.

    Raises:
        PlanError: Nobody knows its collision bodies.
    """
    if not is_described(station_robot.model):
        raise PlanError(
            f"no motion is planned for {station_robot.model}: "
            "without collision bodies nobody can tell whether one is clear",
            hint="`hil new own-urdf --urdf ARM.urdf` describes it with them; built in are "
            f"{', '.join(arm_names())}",
        )
    return load_arm(station_robot.model)


def workspace_of(
    spec: ExperimentSpec, station_robot: StationRobot, arm: ArmDescription, rate_hz: float
) -> Workspace:
    """Where the arm of an experiment may be and how fast, with the body of every load."""
    excitation = spec.excitation
    low, high = draw_range(excitation, arm)
    loads = [(load.payload(), load.size_m) for load in spec.loads]
    at_rest = isinstance(excitation, Dwell)
    return Workspace(
        joint_names=arm.joint_names,
        q_min=arm.q_min,
        q_max=arm.q_max,
        low=low,
        high=high,
        collision=collision_model(arm, station_robot.surroundings, loads),
        clearance_m=station_robot.surroundings.clearance_m,
        velocity=float(np.radians(excitation.max_velocity_deg_s)),
        acceleration=float(np.radians(excitation.max_acceleration_deg_s2)),
        jerk=float(np.radians(excitation.max_jerk_deg_s3)),
        rate_hz=rate_hz,
        condition=condition_score(arm, station_robot.gravity_m_s2, at_rest=at_rest),
        space=declared_space(spec.interlocks, arm, [load.size_m for load in spec.loads]),
    )


def roadmap_of(workspace: Workspace) -> Roadmap:
    """How to get about in a workspace; the same one gives the same roadmap."""
    poses = ROADMAP_POSES if workspace.space is None else CONFINED_ROADMAP_POSES
    return Roadmap(workspace, roomy_poses(workspace, poses, ROADMAP_SEED))


def checked_start(start: FloatArray, roadmap: Roadmap) -> FloatArray:
    """The pose (n,) [rad] the robot stands in, once it is known that it can leave it.

    Raises:
        PlanError: It is no pose, touches something, or no clear way leads away from it.
    """
    workspace = roadmap.workspace
    if start.shape != (len(workspace.joint_names),) or not np.isfinite(start).all():
        raise PlanError(
            f"the robot's current pose is {start.tolist()}, "
            f"not {len(workspace.joint_names)} joint positions",
            hint="see whether the robot is powered and its encoders are read",
        )
    complaint = workspace.complaint(start)
    if not complaint and roadmap.way(start, roadmap.home) is None:
        complaint = "no clear way leads away from it"
    if complaint:
        raise PlanError(
            f"the robot cannot leave its current pose safely: {complaint}",
            hint="jog the robot to a pose with more room around it and plan again, "
            f"{workspace.larger_space or 'or '}describe the station's surroundings as they are",
        )
    return start
