"""Where a spec's robot may be: its arm, its workspace, and the ways through it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.arms import ArmDescription, arm_names, is_described, load_arm
from hil.core import FloatArray, PlanError
from hil.excitation import STANDSTILL_RAD, Roadmap, Workspace, read_waypoints, roomy_poses
from hil.planning.interlocks import declared_space
from hil.planning.limits import draw_range
from hil.planning.quality import condition_score
from hil.planning.surroundings import collision_model
from hil.spec import Dwell, ExperimentSpec, Fourier, StationRobot

ROADMAP_POSES = 48
CONFINED_ROADMAP_POSES = 96
"""Where the flange is confined fewer straight lines are clear: below a height of 0.5 m 48 poses
connect 37 % of the clear ones of a UR5, 96 connect 50 %, and 144 no more."""

MOST_WANTED = 48
"""Poses of a program that a roadmap is about: every pair is looked at, and a file may have
thousands."""

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


def roadmap_of(
    workspace: Workspace, *, wanted: FloatArray | None = None, start: FloatArray | None = None
) -> Roadmap:
    """Return the ways through a workspace; the same arguments give the same roadmap.

    Where the flange is confined, poses drawn from the joint ranges may miss the configuration in
    which the program is, or the robot stands. Without confinement only drawn poses count.

    Args:
        workspace: Where the ways must be clear.
        wanted: (k, n) poses that have to be reached [rad].
        start: (n,) where the robot stands [rad].

    Raises:
        PlanError: Hardly any pose is clear, no two are connected, or `start` is no pose.
    """
    if workspace.space is None:
        return Roadmap(workspace, roomy_poses(workspace, ROADMAP_POSES, ROADMAP_SEED))
    if start is not None:
        _require_pose(start, workspace)
    wanted = None if wanted is None else _some_clear(workspace, wanted)
    try:
        poses = roomy_poses(workspace, CONFINED_ROADMAP_POSES, ROADMAP_SEED)
    except PlanError:
        if wanted is None or not len(wanted):
            raise
        poses = np.empty((0, len(workspace.joint_names)))
    return Roadmap(workspace, poses, wanted=wanted, start=start)


def _some_clear(workspace: Workspace, q: FloatArray) -> FloatArray:
    """Return clear ones of `q` (k, n) that differ, at most `MOST_WANTED`."""
    chosen: list[FloatArray] = []
    rows = np.linspace(0, len(q) - 1, min(len(q), MOST_WANTED)).round().astype(int)
    some = q[rows]
    for pose in some[workspace.is_clear(some)]:
        if all(np.max(np.abs(pose - other)) >= STANDSTILL_RAD for other in chosen):
            chosen.append(pose)
    return np.array(chosen).reshape(len(chosen), q.shape[1])


def poses_of_file(
    excitation: Dwell | Fourier, workspace: Workspace, folder: Path
) -> FloatArray | None:
    """Return the poses (N, n) [rad] of the file that a program is read from; None without one.

    Raises:
        SpecError: The file cannot be read; see `read_waypoints`.
    """
    if not isinstance(excitation, Dwell) or excitation.file is None:
        return None
    path = folder / excitation.file
    return read_waypoints(path, workspace.joint_names, excitation.stated_unit).q


def checked_start(start: FloatArray, roadmap: Roadmap) -> FloatArray:
    """The pose (n,) [rad] the robot stands in, once it is known that it can leave it.

    Raises:
        PlanError: It is no pose, touches something, or no clear path leads away from it.
    """
    workspace = roadmap.workspace
    _require_pose(start, workspace)
    complaint = workspace.complaint(start)
    ways = ["jog the robot to a pose with more room around it and plan again"]
    if not complaint and roadmap.way(start, roadmap.home) is None:
        why = workspace.obstacle([workspace.line(start, roadmap.home)])
        complaint = "no clear path leads from it to the poses of the program" + (
            f"; on the straight one to the roomiest of them {why}" if why else ""
        )
        confined = workspace.space is not None
    else:
        confined = bool(workspace.depth(start[None])[0] < workspace.clearance_m)
        if 0 < workspace.clearance(start[None])[0] < workspace.clearance_m:
            ways.append(
                f"reduce clearance_m ({workspace.clearance_m:g} m) in the station's surroundings"
            )
    if complaint:
        if confined:
            ways.append("move that side of the workspace interlock outwards")
        raise PlanError(
            f"the robot cannot leave its current pose safely: {complaint}",
            hint=f"{', '.join(ways)}, or describe the station's surroundings as they are",
        )
    return start


def _require_pose(start: FloatArray, workspace: Workspace) -> None:
    if start.shape != (len(workspace.joint_names),) or not np.isfinite(start).all():
        raise PlanError(
            f"the robot's current pose is {start.tolist()}, "
            f"not {len(workspace.joint_names)} joint positions",
            hint="see whether the robot is powered and its encoders are read",
        )
