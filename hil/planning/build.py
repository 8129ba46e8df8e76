"""Construction of a plan from a spec and a robot of a station, with checks of every sample."""

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
    """Return the plan of an experiment; the same arguments always give the same plan.

    Args:
        spec: Spec of the experiment.
        station_robot: Station entry of the robot, including its surroundings.
        start_q: (n,) present joint positions [rad]; by default the pose of the joint range with the
            most free space.
        rate_hz: Rate of the robot's set-points and states [Hz]; by default the rate in the
            description of the arm.
        watch: Callback that receives the progress of long computations of trajectories.
        part: Part of the program to execute and its speed, for a commissioning run; None for the
            whole program.

    Raises:
        SpecError: The spec exceeds the limits of the arm, or its waypoint file has errors; the
            message lists all problems.
        PlanError: No collision-free motion satisfies the spec, or the plan would measure nothing.
        PluginError: The excitation is missing or cannot be loaded.
    """
    arm = plannable_arm(station_robot)
    rate = rate_hz or arm.rate_hz
    if problems := excesses(spec, arm, rate, station_robot.surroundings.clearance_m):
        raise SpecError(
            "\n".join(map(str, problems)), hint="change these values, or use a different robot"
        )
    workspace = workspace_of(spec, station_robot, arm, rate)
    here = None if start_q is None else np.asarray(start_q)
    wanted = poses_of_file(spec.excitation, workspace)
    roadmap = roadmap_of(workspace, wanted=wanted, start=here)
    start = roadmap.home if here is None else checked_start(here, roadmap)
    setting = setting_of(spec, station_robot, arm, workspace, watch=watch)
    # The program is computed last, because its optimisation may take minutes.
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
    """Return the reference visit of a program of trajectories; None if it has no reference visits.

    By default the reference pose is the home pose. The home pose satisfies the required clearance,
    but joint positions a few degrees from the home pose, from which the arm approaches it, possibly
    violate the clearance. If the approach to the home pose violates the clearance, the reference
    pose is the roadmap pose with the most free space whose approach satisfies the clearance.
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
    """Return the reference visit at the pose of the spec, by default at the pose `q` (n,).

    The return value is None if the spec has no reference visits.
    """
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
                    hint=f"{workspace.larger_space}set reference.q_deg to a pose with more free "
                    "space, disable the reference visits (reference.every: 0), or reduce "
                    "clearance_m in the station's surroundings",
                )
            raise SpecError(
                f"reference.q_deg: {complaint}",
                hint=f"{workspace.larger_space}choose a pose with more free space",
            )
    if roadmap.way(roadmap.home, visit.entry) is None:
        why = workspace.obstacle([workspace.line(roadmap.home, visit.entry)])
        raise PlanError(
            f"no collision-free path leads to the reference pose; on the straight path: {why}",
            hint=f"{workspace.larger_space}choose a different reference.q_deg",
        )
    return visit


def _steps(
    spec: ExperimentSpec,
    arrangement: Arrangement,
    program: Program,
    start: FloatArray,
    warm_up_s: float,
) -> Iterator[Step]:
    """Yield the numbered steps for a sequence of loads and actions."""
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
    """Yield load index and action of the whole program, in order, for every load.

    The action None represents a change of the payload. Payloads are changed and checked in the home
    pose. The arm is warmed up a single time, before the first measurement.
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
    """Return the plan with its margins; raise if a margin is negative."""
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
    """Return the measurements that a spec requires, as planned by its excitation.

    Args:
        spec: Spec, which names the excitation of the experiment.
        roadmap: Roadmap for the arm with every load of the spec.
        setting: Dynamics of the robot, for an excitation that needs them.

    Raises:
        SpecError, PlanError: The requirements of the spec cannot be satisfied.
        PluginError: The excitation is missing or cannot be loaded.
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
    """Return the robot of a spec at its station, with the data that its dynamics need.

    Args:
        spec: Spec, which lists the loads of the experiment.
        station_robot: Station entry with mounting orientation and surroundings.
        arm: Description of the arm.
        workspace: Workspace of the arm with every load of the spec.
        watch: Callback that receives the progress of long computations of trajectories.
        cache: Cache of computed trajectories; by default the cache of this user.
    """
    collision: Any = workspace.collision  # a CollisionModel, of which only a part is used
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
    """Return the interlocks that restrict the position of the flange; empty if there are none."""
    confining = [
        interlock.model_dump(mode="json")
        for interlock in spec.interlocks
        if isinstance(interlock, WorkspaceInterlock) and interlock.enabled
    ]
    return {"workspace": confining} if confining else {}


def _plain(value: Any) -> Any:
    """Return the value of a field of an arm description in JSON form."""
    return value.tolist() if isinstance(value, np.ndarray) else repr(value)


def _names(arm: ArmDescription) -> list[str]:
    """Return the names of the arm fields that affect motions: all except `sources`."""
    return [field.name for field in fields(arm) if field.name != "sources"]
