"""From a spec and a station's robot to a plan in which every sample of every motion is checked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np

from hil import plugins
from hil.arms import ArmDescription, arm_names, load_arm
from hil.errors import PlanError, SpecError
from hil.excite.arrange import Arrangement
from hil.excite.poses import roomy_poses
from hil.excite.roadmap import Roadmap
from hil.excite.visit import Action, Excitation, Program, Visit, pose_visit
from hil.excite.workspace import Workspace
from hil.plan.interlocks import interlock_margins
from hil.plan.limits import draw_range, excesses
from hil.plan.margins import margins_of
from hil.plan.plan import DwellRule, LoadStep, Plan, Step
from hil.plan.quality import condition_number, condition_score
from hil.plan.surroundings import collision_model
from hil.plan.weighing import weigh_dwell, weigh_visits
from hil.spec.experiment import Dwell, ExperimentSpec
from hil.spec.station import StationRobot
from hil.typing import FloatArray

ROADMAP_POSES = 48
ROADMAP_SEED = 0
REFERENCE_DELTA_DEG = 3.0


def build_plan(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    *,
    start_q: FloatArray | None = None,
    rate_hz: float | None = None,
    folder: Path | None = None,
) -> Plan:
    """The plan for an experiment; the same arguments give the same plan.

    Args:
        spec: What is wanted.
        station_robot: The arm and what stands around it.
        start_q: (n,) where the robot stands now [rad]; by default the roomiest pose of its range.
        rate_hz: The robot's own rate; by default that of the arm's description.
        folder: Where relative paths in the spec start; by default the working directory.

    Raises:
        SpecError: The spec asks for more than the arm can do, or its waypoint file has mistakes;
            everything that is wrong is listed.
        PlanError: No clear motion does what the spec asks for.
        PluginError: The excitation is missing or does not load.
    """
    arm = _arm(station_robot)
    rate = rate_hz or arm.rate_hz
    if problems := excesses(spec, arm, rate):
        raise SpecError("\n".join(problems), hint="change these values, or take another robot")
    workspace = workspace_of(spec, station_robot, arm, rate)
    roadmap = roadmap_of(workspace)
    start = roadmap.home if start_q is None else checked_start(np.asarray(start_q), roadmap)
    kind = plugins.load("hil.excitations", spec.excitation.kind)
    excitation: Excitation = kind(spec.excitation, folder or Path())
    program = excitation.program(roadmap)
    reference = _reference(spec, roadmap, program)
    weighing = weigh_visits(spec, arm, station_robot.gravity_m_s2, roadmap)
    arrangement = Arrangement(roadmap, reference, spec.reference.every, weighing)
    steps = tuple(_steps(spec, arrangement, program, start))
    loads = tuple(LoadStep(load.payload(), load.prompt, load.size_m) for load in spec.loads)
    return _complete(spec, station_robot, arm, workspace, steps, loads)


def _complete(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    workspace: Workspace,
    steps: tuple[Step, ...],
    loads: tuple[LoadStep, ...],
) -> Plan:
    """The plan with its margins; refuses a negative one."""
    measured = [step.motion for step in steps if step.measures and step.motion]
    weighed = any(step.kind == "weigh" for step in steps)
    margins = margins_of(steps, loads, arm, station_robot.gravity_m_s2, workspace)
    motions = [step.motion for step in steps if step.motion]
    sizes = [load.size_m for load in loads]
    margins |= interlock_margins(
        spec.interlocks, arm, sizes, motions, workspace.rate_hz, margins["clearance_m"]
    )
    assert workspace.condition is not None
    return Plan(
        name=spec.name,
        robot_model=station_robot.model,
        joint_names=arm.joint_names,
        rate_hz=workspace.rate_hz,
        steps=steps,
        loads=loads,
        dwell=_dwell_rule(spec),
        weigh_dwell=weigh_dwell(_dwell_rule(spec), workspace.rate_hz) if weighed else None,
        margins=margins,
        condition_number=condition_number(workspace.condition, measured, workspace.rate_hz),
    )


def _arm(station_robot: StationRobot) -> ArmDescription:
    if station_robot.model not in arm_names():
        raise PlanError(
            f"no motion is planned for {station_robot.model}: "
            "without collision bodies nobody can tell whether one is clear",
            hint=f"plans are made for the built-in arms {', '.join(arm_names())}; "
            "recordings of other robots can be imported and fitted",
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
    )


def roadmap_of(workspace: Workspace) -> Roadmap:
    """How to get about in a workspace; the same one gives the same roadmap."""
    return Roadmap(workspace, roomy_poses(workspace, ROADMAP_POSES, ROADMAP_SEED))


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
            hint="jog the robot to a pose with more room around it and plan again, or describe "
            "the station's surroundings as they are",
        )
    return start


def _reference(spec: ExperimentSpec, roadmap: Roadmap, program: Program) -> Visit | None:
    """The reference visit: the pose of the spec, the first of a dwell program, or home."""
    if spec.reference.every == 0:
        return None
    dwell = spec.excitation if isinstance(spec.excitation, Dwell) else None
    q = program.visits[0].exit if dwell else roadmap.home
    if spec.reference.q_deg is not None:
        q = np.radians(np.array(spec.reference.q_deg))
    approach = dwell.approach if dwell else "both"
    delta = float(np.radians(dwell.approach_deg if dwell else REFERENCE_DELTA_DEG))
    workspace = roadmap.workspace
    visit = pose_visit(workspace, q, approach, delta, label="reference pose", kind="reference")
    for motion in visit.motions:
        if complaint := workspace.complaint(motion.q_start):
            raise SpecError(
                f"reference.q_deg: {complaint}", hint="choose a pose with more room around it"
            )
    if roadmap.way(roadmap.home, visit.entry) is None:
        raise PlanError(
            "no clear way leads to the reference pose", hint="choose another reference.q_deg"
        )
    return visit


def _steps(
    spec: ExperimentSpec, arrangement: Arrangement, program: Program, start: FloatArray
) -> Iterator[Step]:
    """The sequence as numbered steps."""
    sequence = _sequence(spec, arrangement, program, start)
    for index, (load, action) in enumerate(sequence):
        if action is None:
            yield Step(index, "payload", load=load, checkpoint=True)
        else:
            yield Step(
                index, load=load, **{f.name: getattr(action, f.name) for f in fields(action)}
            )


def _sequence(
    spec: ExperimentSpec, arrangement: Arrangement, program: Program, here: FloatArray
) -> Iterator[tuple[int, Action | None]]:
    """Load and action, the whole program once per load; None stands for changing the load.

    Loads are changed in the home pose and weighed from there; the arm is warmed up once.
    """
    home = arrangement.roadmap.home
    for load in range(len(spec.loads)):
        if load > 0:
            yield from ((load - 1, action) for action in arrangement.go_home(here))
            here = home
        yield load, None
        actions: list[Action] = []
        if arrangement.weighing:
            actions += arrangement.go_home(here)
            actions += arrangement.tour(arrangement.weighing, home)
            here = actions[-1].motion.q_end
        if load == 0 and spec.warm_up.duration_s > 0:
            actions += arrangement.go_home(here)
            actions += arrangement.warm_up(home, spec.warm_up.duration_s)
            here = actions[-1].motion.q_end
        actions += arrangement.measure(program, here)
        yield from ((load, action) for action in actions)
        here = actions[-1].motion.q_end


def _dwell_rule(spec: ExperimentSpec) -> DwellRule:
    if not isinstance(spec.excitation, Dwell):
        return DwellRule()
    dwell = spec.excitation
    return DwellRule(
        dwell.dwell_s, dwell.samples_per_dwell, dwell.settle_rad_s, dwell.settle_timeout_s
    )
