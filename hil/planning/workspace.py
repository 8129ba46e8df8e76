"""Workspace of a spec's robot: the arm, its surroundings, and collision-free paths."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from hil.arms import ArmDescription, Capsule, Payload, arm_names, is_described, load_arm
from hil.core import FloatArray, PlanError
from hil.dynamics import Box, CollisionModel, Environment, Plane, payload_capsule
from hil.excitation import STANDSTILL_RAD, Line, Roadmap, Workspace, read_waypoints, roomy_poses
from hil.planning.checks import BodySize, condition_score, declared_space, draw_range
from hil.spec import Dwell, ExperimentSpec, Fourier, StationRobot, Surroundings

ROADMAP_POSES = 48

CONFINED_ROADMAP_POSES = 96
"""Number of roadmap poses if the flange is confined, because fewer straight lines are then
collision-free.

Below a height of 0.5 m, 48 roadmap poses connect 37 % of the collision-free poses of a UR5, 96
poses connect 50 %, and 144 poses do not connect more.
"""

MOST_WANTED = 48
"""Maximum number of program poses that a roadmap contains.

The number is limited because every pair of poses is checked, and a waypoint file may contain
thousands of poses.
"""

ROADMAP_SEED = 0


def plannable_arm(station_robot: StationRobot) -> ArmDescription:
    """Return the arm of a station's robot; raise if motions cannot be planned for the arm.

    Raises:
        PlanError: The description of the arm contains no collision bodies.
    """
    if not is_described(station_robot.model):
        raise PlanError(
            f"no motion can be planned for {station_robot.model}, because its collision bodies "
            "are unknown",
            hint="create a description with collision bodies: hil new own-urdf --urdf ARM.urdf; "
            f"built-in arms: {', '.join(arm_names())}",
        )
    return load_arm(station_robot.model)


def workspace_of(
    spec: ExperimentSpec, station_robot: StationRobot, arm: ArmDescription, rate_hz: float
) -> Workspace:
    """Return the workspace of an experiment's arm: ranges, speeds and the bodies of all loads."""
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
    """Return a roadmap of a workspace; the same arguments give the same roadmap.

    If the flange is confined, poses drawn from the joint ranges possibly miss the arm configuration
    of the program or of the robot, so `wanted` and `start` are added to the roadmap. If the flange
    is not confined, the roadmap contains only poses drawn from the joint ranges.

    Args:
        workspace: Workspace in which the paths must be collision-free.
        wanted: (k, n) poses that the program has to reach [rad].
        start: (n,) present joint positions of the robot [rad].

    Raises:
        PlanError: Too few poses are collision-free, no two poses are connected, or `start` is not a
            valid pose.
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


def _require_pose(start: FloatArray, workspace: Workspace) -> None:
    if start.shape != (len(workspace.joint_names),) or not np.isfinite(start).all():
        raise PlanError(
            f"the robot's current pose is {start.tolist()}, "
            f"not {len(workspace.joint_names)} joint positions",
            hint="check that the robot is powered and its encoders are read",
        )


def _some_clear(workspace: Workspace, q: FloatArray) -> FloatArray:
    """Return distinct collision-free poses from `q` (k, n), `MOST_WANTED` at most."""
    chosen: list[FloatArray] = []
    rows = np.linspace(0, len(q) - 1, min(len(q), MOST_WANTED)).round().astype(int)
    some = q[rows]
    for pose in some[workspace.is_clear(some)]:
        if all(np.max(np.abs(pose - other)) >= STANDSTILL_RAD for other in chosen):
            chosen.append(pose)
    return np.array(chosen).reshape(len(chosen), q.shape[1])


def poses_of_file(excitation: Dwell | Fourier, workspace: Workspace) -> FloatArray | None:
    """Return the poses (N, n) [rad] of the waypoint file of a program; None without a file.

    Raises:
        SpecError: The waypoint file cannot be read; see `read_waypoints`.
    """
    if not isinstance(excitation, Dwell) or excitation.file is None:
        return None
    path = Path(excitation.file)
    return read_waypoints(path, workspace.joint_names, excitation.stated_unit).q


def checked_start(start: FloatArray, roadmap: Roadmap) -> FloatArray:
    """Return the present pose (n,) [rad] of the robot; raise if the robot cannot leave this pose.

    Raises:
        PlanError: The present pose is invalid or in collision, or no collision-free path leads away
            from it.
    """
    workspace = roadmap.workspace
    _require_pose(start, workspace)
    complaint = workspace.complaint(start)
    ways = ["jog the robot to a pose with more free space and plan again"]
    if not complaint and roadmap.way(start, roadmap.home) is None:
        why = workspace.obstacle([workspace.line(start, roadmap.home)])
        complaint = "no collision-free path leads from it to the poses of the program" + (
            f"; on the straight path to the pose with the most free space: {why}" if why else ""
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
            hint=f"{', '.join(ways)}, or correct the station's surroundings",
        )
    return start


def collision_model(
    arm: ArmDescription,
    surroundings: Surroundings,
    loads: Sequence[tuple[Payload, BodySize | None]],
) -> CollisionModel:
    """Return the collision model of an arm, its surroundings and a body that encloses all loads.

    A single body represents all loads, so that the program is the same with every load. Planning,
    preflight and interlocks use the same collision model. The collision model is built a single
    time and shared, because it does not change.
    """
    capsules = [body for load, size in loads if (body := _capsule(load, size, arm.n_joints))]
    return _built(arm, _environment(surroundings), envelope(capsules) if capsules else None)


def _capsule(load: Payload, size: BodySize | None, flange_link: int) -> Capsule | None:
    if size is None:
        return payload_capsule(load, flange_link)
    length, radius = size
    return Capsule(flange_link, (0.0, 0.0, 0.0), (0.0, 0.0, length), radius)


@lru_cache(maxsize=16)
def _built(arm: ArmDescription, around: Environment, payload: Capsule | None) -> CollisionModel:
    return CollisionModel(arm, around, payload)


def _environment(surroundings: Surroundings) -> Environment:
    return Environment(
        table_z=surroundings.table_z_m,
        walls=tuple(Plane(w.point_m, w.normal, w.name) for w in surroundings.walls),
        boxes=tuple(Box(b.centre_m, b.size_m, b.name) for b in surroundings.boxes),
    )


def envelope(capsules: Sequence[Capsule]) -> Capsule:
    """Return one capsule that encloses several capsules with the same start point.

    The returned capsule has the longest of the axes. On every other axis, the end point is farthest
    from the longest axis, because the distance to a convex set is a convex function.
    """
    ends = [np.array(capsule.b) for capsule in capsules]
    longest = max(ends, key=lambda end: float(end @ end))
    radius = max(
        capsule.radius + _off_axis(end, longest)
        for capsule, end in zip(capsules, ends, strict=True)
    )
    x, y, z = (float(c) for c in longest)
    return Capsule(capsules[0].link, (0.0, 0.0, 0.0), (x, y, z), radius)


def _off_axis(point: FloatArray, end: FloatArray) -> float:
    """Return the distance of `point` to the segment from the origin to `end`."""
    squared = float(end @ end)
    along = min(max(float(point @ end) / squared, 0.0), 1.0) if squared > 0 else 0.0
    return float(np.linalg.norm(point - along * end))


class Approach:
    """Path search in the workspace of an experiment, within its speeds and clearances.

    Args:
        spec: Spec of the experiment.
        station_robot: Station entry of the robot, including its surroundings.
        rate_hz: Rate at which the motions of the plan are sampled [Hz].
        here: (n,) present joint positions [rad].
        targets: (k, n) poses of the plan at which execution may resume [rad].

    Raises:
        PlanError: The arm cannot leave its present pose without a collision.
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
        """Return collision-free lines from one joint position (n,) to another [rad].

        Raises:
            PlanError: No collision-free path exists between the positions.
        """
        lines = self._roadmap.way(here, target)
        if lines is None:
            raise PlanError(
                f"no collision-free path leads from {_degrees(here)} to {_degrees(target)}",
                hint="jog the robot to a pose with more free space and resume from there",
            )
        return lines


def _degrees(q: FloatArray) -> str:
    return f"({', '.join(f'{angle:.1f}' for angle in np.degrees(q))})°"
