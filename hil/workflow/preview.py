"""Plan, preview and trajectories of an experiment, without any motion.

`planned` computes the plan for the robot of an experiment; if connecting to the robot is allowed,
the plan starts at the present pose of the robot. `plan` returns the plan of `planned`, and
`preview_experiment` also returns its preview. `appraise_excitation` (used by `hil optimise`)
computes only the trajectories, or reads them from the cache, and compares them with random
trajectories.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import SpecError
from hil.excitation import (
    Advance,
    Appraisal,
    FourierSeries,
    Limits,
    Roadmap,
    Setting,
    Watch,
    appraise,
    unwatched,
    user_cache,
)
from hil.planning import (
    ExcitationReport,
    Experiment,
    Plan,
    PlanPreview,
    build_plan,
    excesses,
    leased_and_connected,
    opened,
    plan_for,
    plannable_arm,
    preview,
    program_of,
    require_experiment,
    roadmap_of,
    setting_of,
    workspace_of,
)
from hil.robot import Robot
from hil.spec import ExperimentSpec, Fourier
from hil.workflow.checks import missing_extras, require_within_reach
from hil.workflow.interlocks import RunInterlocks

WITHOUT_THE_ROBOT = (
    "planned without connecting to the robot: the plan begins in the pose with the most clearance, "
    "with the manufacturer's limits; `hil run` and `hil plan --connect` plan from the present pose "
    "of the arm"
)


@contextlib.contextmanager
def planned(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> Iterator[tuple[Robot, Plan, bool]]:
    """Yield the robot, the plan, and whether the plan starts at the present pose of the robot.

    By default, hil does not connect to a robot in wall time, because plans are often made before
    the arm is switched on, or while other users need the arm. Without a connection, the plan starts
    in the pose of the joint range with the most free space, and uses the rate and limits that the
    driver knows without a connection.

    Args:
        experiment: Experiment, which names robot and station.
        connect: Whether hil leases a robot in wall time and connects to it, so that the plan starts
            at the present pose of the robot.
        watch: Callback that receives the progress of long computations of trajectories.

    Raises:
        RobotConnectionError, PluginError, SpecError, RobotError: The robot is not available, see
            `held`.
        SpecError: The arm cannot execute the experiment, or the run would give no result; see
            `require_within_reach`.
        PlanError: No safe plan exists for the spec.
    """
    with opened(experiment.spec.robot, experiment.robot) as robot:
        can = robot.capabilities
        require_within_reach(experiment, can)
        if can.clock == "wall" and not connect:
            plan = build_plan(
                experiment.spec,
                experiment.robot,
                rate_hz=can.rate_hz,
                watch=watch,
                part=experiment.commissioning,
            )
            yield robot, plan, False
            return
        with leased_and_connected(experiment, robot):
            yield robot, plan_for(experiment, robot, watch), True


def plan(experiment: Experiment, *, connect: bool = False) -> Plan:
    """Return the plan of an experiment; the robot does not move.

    The plan of a robot on a virtual clock starts at its present pose. By default, hil does not
    connect to a robot in wall time: the plan then starts in the pose of the joint range with the
    most free space.

    Args:
        experiment: Experiment returned by `load`.
        connect: Whether the plan of a robot in wall time also starts at the present pose of the
            robot.

    Raises:
        PlanError: No safe plan exists for the spec.
        RobotError: The pose of the robot cannot be read, or a different process uses the robot.
    """
    require_experiment(experiment)
    with planned(experiment, connect=connect) as (_, plan, _):
        return plan


def preview_experiment(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> tuple[Plan, PlanPreview]:
    """Return the plan of an experiment and its preview; the robot does not move.

    Args:
        experiment: Experiment with spec and station.
        connect: Whether hil connects to a robot in wall time, see `planned`.
        watch: Callback that receives the progress of long computations of trajectories.

    Raises:
        SpecError: The arm cannot execute the experiment, or the run would give no result.
        PlanError: No safe plan exists for the spec, or an interlock cannot be evaluated.
        RobotError: The pose of the robot cannot be read.
    """
    with planned(experiment, connect=connect, watch=watch) as (robot, plan, from_where_it_stands):
        watching = RunInterlocks(experiment, robot, plan).all.describe()
    unasked = () if from_where_it_stands else (WITHOUT_THE_ROBOT,)
    lacking = missing_extras(experiment.spec) if experiment.commissioning is None else ()
    return plan, preview(plan, watching, (*unasked, *lacking))


def appraise_excitation(
    experiment: Experiment, *, fresh: bool = False, watch: Watch = unwatched
) -> ExcitationReport:
    """Optimise the trajectories of an experiment, or read them from the cache, and evaluate them.

    `appraise_excitation` does not connect to the robot.

    Args:
        experiment: Experiment with spec and station.
        fresh: Whether trajectories that are in the cache are computed again.
        watch: Callback that receives the progress of the optimisation.

    Raises:
        SpecError: The excitation has no trajectories, or requires more than the arm can execute.
        PlanError: No collision-free motion satisfies the spec.
    """
    spec = experiment.spec
    if not isinstance(spec.excitation, Fourier):
        raise SpecError(
            f"{spec.name} is a {spec.excitation.kind} program, which has no trajectories",
            hint="`hil plan` shows the motion; `hil optimise` requires excitation.kind: fourier",
        )
    with opened(spec.robot, experiment.robot) as robot:
        rate_hz = robot.capabilities.rate_hz
    arm = plannable_arm(experiment.robot)
    if problems := excesses(spec, arm, rate_hz, experiment.robot.surroundings.clearance_m):
        raise SpecError(
            "\n".join(map(str, problems)), hint="change these values, or choose a different robot"
        )
    workspace = workspace_of(spec, experiment.robot, arm, rate_hz)
    roadmap, progress = roadmap_of(workspace), _Progress(watch)
    cache = user_cache(fresh=fresh)
    setting = setting_of(spec, experiment.robot, arm, workspace, watch=progress, cache=cache)
    began = time.monotonic()
    motions = _trajectories_of(spec, roadmap, setting)
    seconds = time.monotonic() - began
    appraisal = _appraised(spec, roadmap, setting, motions)
    random = None
    if spec.excitation.optimise is not None:  # otherwise the trajectories are random already
        unoptimised = spec.excitation.model_copy(update={"optimise": None})
        drawn = spec.model_copy(update={"excitation": unoptimised})
        random = _appraised(spec, roadmap, setting, _trajectories_of(drawn, roadmap, setting))
    return ExcitationReport(
        experiment, appraisal, random, len(progress.computed), seconds, tuple(progress.notes)
    )


class _Progress:
    """Progress callback that stores the computed trajectories and the notes of the optimiser."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self.computed: set[int] = set()
        self.notes: list[str] = []

    def __call__(self, advance: Advance) -> None:
        if advance.note:
            self.notes.append(advance.note)
        else:
            self.computed.add(advance.trajectory)
        self._watch(advance)


def _trajectories_of(
    spec: ExperimentSpec, roadmap: Roadmap, setting: Setting
) -> list[FourierSeries]:
    visits = program_of(spec, roadmap, setting).visits
    motions = [motion for visit in visits for motion in visit.motions]
    return [motion for motion in motions if isinstance(motion, FourierSeries)]


def _appraised(
    spec: ExperimentSpec, roadmap: Roadmap, setting: Setting, motions: Sequence[FourierSeries]
) -> Appraisal:
    assert isinstance(spec.excitation, Fourier)
    optimise = spec.excitation.optimise
    return appraise(
        motions,
        roadmap.workspace,
        setting,
        limits_of(spec.excitation, roadmap, setting),
        rotor=optimise is None or optimise.rotor,
        friction=optimise is not None and optimise.friction,
    )


def limits_of(program: Fourier, roadmap: Roadmap, setting: Setting) -> Limits:
    """Return the joint limits that apply to the trajectories of a program."""
    workspace, optimise = roadmap.workspace, program.optimise
    ones = np.ones(len(workspace.joint_names))
    jerk = optimise.max_jerk_deg_s3 if optimise else None
    clearance_mm = optimise.clearance_mm if optimise else None
    return Limits(
        q_min=workspace.low,
        q_max=workspace.high,
        velocity=workspace.velocity * ones,
        acceleration=workspace.acceleration * ones,
        jerk=(np.inf if jerk is None else np.radians(jerk)) * ones,
        effort=(optimise.torque_percent / 100 if optimise else 1.0) * setting.effort_max,
        clearance_m=workspace.clearance_m if clearance_mm is None else 1e-3 * clearance_mm,
    )
