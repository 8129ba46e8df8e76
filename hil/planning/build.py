"""From a spec and a station's robot to a plan in which every sample of every motion is checked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, HilError, PlanError, SpecError, plugins
from hil.dynamics import RobotModel
from hil.excitation import (
    Action,
    Arrangement,
    Computes,
    Excitation,
    ExcitationCache,
    Program,
    Roadmap,
    Setting,
    Visit,
    Watch,
    Workspace,
    pose_visit,
    unwatched,
    user_cache,
)
from hil.planning.checks import condition_number, excesses, interlock_margins, margins_of
from hil.planning.commissioning import Commissioning
from hil.planning.plan import DwellRule, LoadStep, Plan, Step
from hil.planning.weighing import weigh_dwell, weigh_visits
from hil.planning.workspace import (
    checked_start,
    plannable_arm,
    poses_of_file,
    roadmap_of,
    workspace_of,
)
from hil.spec import Dwell, ExperimentSpec, StationRobot, WorkspaceInterlock

REFERENCE_DELTA_DEG = 3.0


def build_plan(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    *,
    start_q: FloatArray | None = None,
    rate_hz: float | None = None,
    watch: Watch = unwatched,
    part: Commissioning | None = None,
) -> Plan:
    """The plan for an experiment; the same arguments give the same plan.

    Args:
        spec: What is wanted.
        station_robot: The arm and what stands around it.
        start_q: (n,) where the robot stands now [rad]; by default the roomiest pose of its range.
        rate_hz: The robot's own rate; by default that of the arm's description.
        watch: Is told how far trajectories are that take long to compute.
        part: For a commissioning run: what of the program, and how fast; None for all of it.

    Raises:
        SpecError: The spec asks for more than the arm can do, or its waypoint file has mistakes;
            everything that is wrong is listed.
        PlanError: No clear motion does what the spec asks for, or nothing of it would be measured.
        PluginError: The excitation is missing or does not load.
    """
    arm = plannable_arm(station_robot)
    rate = rate_hz or arm.rate_hz
    if problems := excesses(spec, arm, rate, station_robot.surroundings.clearance_m):
        raise SpecError(
            "\n".join(map(str, problems)), hint="change these values, or take another robot"
        )
    workspace = workspace_of(spec, station_robot, arm, rate)
    here = None if start_q is None else np.asarray(start_q)
    wanted = poses_of_file(spec.excitation, workspace)
    roadmap = roadmap_of(workspace, wanted=wanted, start=here)
    start = roadmap.home if here is None else checked_start(here, roadmap)
    setting = setting_of(spec, station_robot, arm, workspace, watch=watch)
    # What takes long comes last: a program may take minutes to be optimised.
    whole, dwells = part is None or not part.shortened, isinstance(spec.excitation, Dwell)
    gravity = station_robot.gravity_m_s2
    weighing = weigh_visits(spec, arm, gravity, roadmap) if whole else ()
    reference = _default_reference(spec, roadmap) if whole and not dwells else None
    program = program_of(spec, roadmap, setting)
    if whole and dwells:
        reference = _reference(spec, roadmap, program.visits[0].exit)
    arrangement = Arrangement(
        roadmap, reference, spec.reference.every, weighing, nearest_first=not whole
    )
    warm_up_s = spec.warm_up.duration_s if part is None else 0.0
    plan = Plan(
        name=spec.name,
        robot_model=station_robot.model,
        joint_names=arm.joint_names,
        rate_hz=workspace.rate_hz,
        steps=tuple(_steps(spec, arrangement, program, start, warm_up_s)),
        loads=tuple(LoadStep(load.payload(), load.prompt, load.size_m) for load in spec.loads),
        dwell=_dwell_rule(spec),
    )
    return _complete(plan if part is None else part.of(plan), spec, station_robot, arm, workspace)


def _default_reference(spec: ExperimentSpec, roadmap: Roadmap) -> Visit | None:
    """Return the reference visit of a program of trajectories, or None without one.

    By default it is at the home pose. The home pose keeps its distance, but the joint positions a
    few degrees around it, from which it is approached, may not: then the roomiest pose of the
    roadmap is taken that is approached with all the distance required.
    """
    if spec.reference.q_deg is not None:
        return _reference(spec, roadmap, roadmap.home)
    refused: HilError | None = None
    for i in np.argsort(-roadmap.workspace.room(roadmap.poses), kind="stable"):
        try:
            return _reference(spec, roadmap, roadmap.poses[i])
        except (SpecError, PlanError) as error:
            refused = refused or error
    assert refused is not None
    raise refused


def _reference(spec: ExperimentSpec, roadmap: Roadmap, q: FloatArray) -> Visit | None:
    """Return the reference visit: at the pose of the spec, else at `q` (n,), or None for none."""
    if spec.reference.every == 0:
        return None
    dwell = spec.excitation if isinstance(spec.excitation, Dwell) else None
    given = spec.reference.q_deg
    if given is not None:
        q = np.radians(np.array(given))
    approach = dwell.approach if dwell else "both"
    delta = float(np.radians(dwell.approach_deg if dwell else REFERENCE_DELTA_DEG))
    workspace = roadmap.workspace
    visit = pose_visit(workspace, q, approach, delta, label="reference pose", kind="reference")
    for motion in visit.motions:
        if complaint := workspace.complaint(motion.q_start):
            if given is None:
                raise PlanError(
                    f"the default reference pose: {complaint}",
                    hint=f"{workspace.larger_space}write a pose with more room around it as "
                    "reference.q_deg, do without one (reference.every: 0), or reduce clearance_m "
                    "in the station's surroundings",
                )
            raise SpecError(
                f"reference.q_deg: {complaint}",
                hint=f"{workspace.larger_space}choose a pose with more room around it",
            )
    if roadmap.way(roadmap.home, visit.entry) is None:
        why = workspace.obstacle([workspace.line(roadmap.home, visit.entry)])
        raise PlanError(
            f"no clear path leads to the reference pose; on the straight path: {why}",
            hint=f"{workspace.larger_space}choose another reference.q_deg",
        )
    return visit


def _steps(
    spec: ExperimentSpec,
    arrangement: Arrangement,
    program: Program,
    start: FloatArray,
    warm_up_s: float,
) -> Iterator[Step]:
    """The sequence as numbered steps."""
    sequence = _sequence(spec, arrangement, program, start, warm_up_s)
    for index, (load, action) in enumerate(sequence):
        if action is None:
            yield Step(index, "payload", load=load, checkpoint=True)
        else:
            yield Step(
                index, load=load, **{f.name: getattr(action, f.name) for f in fields(action)}
            )


def _sequence(
    spec: ExperimentSpec,
    arrangement: Arrangement,
    program: Program,
    here: FloatArray,
    warm_up_s: float,
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
        if load == 0 and warm_up_s > 0:
            actions += arrangement.go_home(here)
            actions += arrangement.warm_up(home, warm_up_s)
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


def _complete(
    plan: Plan,
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    workspace: Workspace,
) -> Plan:
    """The plan with its margins; refuses a negative one."""
    measured = [step.motion for step in plan if step.measures and step.motion]
    weighed = any(step.kind == "weigh" for step in plan)
    margins = margins_of(plan.steps, plan.loads, arm, station_robot.gravity_m_s2, workspace)
    sizes = [load.size_m for load in plan.loads]
    margins |= interlock_margins(
        spec.interlocks, arm, sizes, plan.steps, workspace.rate_hz, margins["clearance_m"]
    )
    assert workspace.condition is not None
    return replace(
        plan,
        weigh_dwell=weigh_dwell(plan.dwell, workspace.rate_hz) if weighed else None,
        margins=margins,
        condition_number=condition_number(workspace.condition, measured, workspace.rate_hz),
    )


def program_of(spec: ExperimentSpec, roadmap: Roadmap, setting: Setting) -> Program:
    """What a spec wants to be measured.

    Args:
        spec: Says which excitation.
        roadmap: How to get about with every load of the spec.
        setting: The robot, for an excitation that computes with its dynamics.

    Raises:
        SpecError, PlanError: What the spec asks for cannot be.
        PluginError: The excitation is missing or does not load.
    """
    kind = plugins.load("hil.excitations", spec.excitation.kind)
    excitation: Excitation = kind(spec.excitation, Path())  # paths in a spec are absolute
    if isinstance(excitation, Computes):
        excitation.compute_with(setting)
    return excitation.program(roadmap)


def setting_of(
    spec: ExperimentSpec,
    station_robot: StationRobot,
    arm: ArmDescription,
    workspace: Workspace,
    *,
    watch: Watch = unwatched,
    cache: ExcitationCache | None = None,
) -> Setting:
    """The robot of a spec at its station, as far as its dynamics go.

    Args:
        spec: Says which loads.
        station_robot: How the arm is mounted and what stands around it.
        arm: Its description.
        workspace: Where it may be, with every load of the spec.
        watch: Is told how far trajectories are that take long to compute.
        cache: Where those are kept; by default this user's.
    """
    collision: Any = workspace.collision  # a CollisionModel, which can do more than is asked of it
    return Setting(
        robot=RobotModel.from_arm(arm.name, gravity=station_robot.gravity_m_s2),
        effort_max=arm.effort_max,
        loads=tuple(load.payload() for load in spec.loads),
        collision=collision,
        identity=_confined(spec)
        | {
            "arm": {name: _plain(getattr(arm, name)) for name in _names(arm)},
            "surroundings": station_robot.surroundings.model_dump(mode="json"),
            "loads": [load.model_dump(mode="json", exclude={"prompt"}) for load in spec.loads],
        },
        cache=user_cache() if cache is None else cache,
        watch=watch,
    )


def _confined(spec: ExperimentSpec) -> dict[str, Any]:
    """Return what confines the flange, and nothing if it may go anywhere."""
    confining = [
        interlock.model_dump(mode="json")
        for interlock in spec.interlocks
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled
    ]
    return {"workspace": confining} if confining else {}


def _plain(value: Any) -> Any:
    """A field of an arm's description as JSON."""
    return value.tolist() if isinstance(value, np.ndarray) else repr(value)


def _names(arm: ArmDescription) -> list[str]:
    """Of what an arm's motions depend on: all but where its numbers come from."""
    return [field.name for field in fields(arm) if field.name != "sources"]
