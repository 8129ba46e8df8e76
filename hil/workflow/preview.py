"""Plan, preview and trajectories of an experiment, before anything moves.

`planned` makes the plan for the robot of an experiment, from the pose where it stands if it may be
connected to; `plan` and `preview_experiment` return what follows from it. `appraise_excitation`
(behind `hil excite`) optimises the trajectories alone, or takes them from the cache, and compares
them with random ones.
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
    "planned without the robot, which was not connected to: the plan begins in the roomiest pose "
    "of its range, and limits are the maker's; `hil run` plans from where the arm stands, and so "
    "does `hil plan --connect`"
)


@contextlib.contextmanager
def planned(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> Iterator[tuple[Robot, Plan, bool]]:
    """Yield the robot, the plan, and whether it begins where the robot stands now.

    A robot in wall time is not connected to by default: plans are made at desks, before the arm is
    switched on, and while others use it. Its plan then begins in the roomiest pose of its range, at
    the rate and within the limits that its driver knows without a connection.

    Args:
        experiment: Says which robot of which station.
        connect: Plan from where a robot in wall time stands now, too; it is leased meanwhile.
        watch: Called with the progress of trajectories that take long to compute.

    Raises:
        RobotConnectionError, PluginError, SpecError, RobotError: See `held`.
        SpecError: The arm cannot do it, or it would give no result; see `require_within_reach`.
        PlanError: No safe plan follows from the spec.
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
    """Return the plan of an experiment; nothing moves.

    The plan of a robot on a virtual clock begins where it stands. One in wall time is not connected
    to: its plan begins in the roomiest pose of its range.

    Args:
        experiment: From `load`.
        connect: Plan from where a robot in wall time stands now, too.

    Raises:
        PlanError: No safe plan follows from the spec.
        RobotError: The robot cannot be asked where it stands, or another process holds it.
    """
    require_experiment(experiment)
    with planned(experiment, connect=connect) as (_, plan, _):
        return plan


def preview_experiment(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> tuple[Plan, PlanPreview]:
    """Return the plan of an experiment and its preview; nothing moves.

    Args:
        experiment: What would be done, and where.
        connect: See `planned`.
        watch: Called with the progress of trajectories that take long to compute.

    Raises:
        SpecError: The arm cannot do it, or it would give no result.
        PlanError: No safe plan follows from the spec, or an interlock cannot be judged.
        RobotError: The robot cannot be asked where it stands.
    """
    with planned(experiment, connect=connect, watch=watch) as (robot, plan, from_where_it_stands):
        watching = RunInterlocks(experiment, robot, plan).all.describe()
    unasked = () if from_where_it_stands else (WITHOUT_THE_ROBOT,)
    lacking = missing_extras(experiment.spec) if experiment.commissioning is None else ()
    return plan, preview(plan, watching, (*unasked, *lacking))


def appraise_excitation(
    experiment: Experiment, *, fresh: bool = False, watch: Watch = unwatched
) -> ExcitationReport:
    """Optimise an experiment's trajectories, or take them from the cache, and appraise them.

    The robot is not connected to.

    Args:
        experiment: What would be done, and where.
        fresh: Optimise again what the cache has.
        watch: Called with the progress.

    Raises:
        SpecError: The excitation has no trajectories, or asks for more than the arm can do.
        PlanError: No motion does what the spec asks for.
    """
    spec = experiment.spec
    if not isinstance(spec.excitation, Fourier):
        raise SpecError(
            f"{spec.name} is a {spec.excitation.kind} program, which has no trajectories",
            hint="`hil plan` shows what it does; `hil excite` is for excitation.kind: fourier",
        )
    with opened(spec.robot, experiment.robot) as robot:
        rate_hz = robot.capabilities.rate_hz
    arm = plannable_arm(experiment.robot)
    if problems := excesses(spec, arm, rate_hz, experiment.robot.surroundings.clearance_m):
        raise SpecError(
            "\n".join(map(str, problems)), hint="change these values, or take another robot"
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
    if spec.excitation.optimise is not None:  # else they are random themselves
        unoptimised = spec.excitation.model_copy(update={"optimise": None})
        drawn = spec.model_copy(update={"excitation": unoptimised})
        random = _appraised(spec, roadmap, setting, _trajectories_of(drawn, roadmap, setting))
    return ExcitationReport(
        experiment, appraisal, random, len(progress.computed), seconds, tuple(progress.notes)
    )


class _Progress:
    """Passes progress on, and remembers which trajectories were computed, and notes."""

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
    """Return the limits of the trajectories of a program."""
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
