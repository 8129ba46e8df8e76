"""What an experiment would do and who would watch it, before anything moves."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from hil.excitation import Watch, unwatched
from hil.planning import (
    Experiment,
    Plan,
    PlanPreview,
    build_plan,
    leased_and_connected,
    opened,
    plan_for,
    preview,
    require_experiment,
)
from hil.robot import Robot
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
    """The robot, the plan, and whether it begins where the robot stands now.

    A robot in wall time is left alone unless it is to be connected to: plans are made at desks,
    before the arm is switched on, and while others drive it. Its plan begins in the roomiest pose
    of its range then, at the rate and within the limits that its driver knows by itself.

    Args:
        experiment: Says which robot of which station.
        connect: Plan from where a robot in wall time stands now, too; it is leased meanwhile.
        watch: Is told how far trajectories are that take long to compute.

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
    """What the robot would do; nothing moves.

    A robot on a virtual clock is asked where it stands. One in wall time is not connected to: its
    plan begins in the roomiest pose of its range.

    Args:
        experiment: From `load`.
        connect: Plan from where a robot in wall time stands now, too.

    Raises:
        PlanError: No safe plan follows from the spec.
        RobotError: The robot cannot be asked where it stands, or another process holds it.
    """
    require_experiment(experiment)
    with planned(experiment, connect=connect) as (_, made, _):
        return made


def preview_experiment(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> tuple[Plan, PlanPreview]:
    """The plan and what it amounts to; nothing moves.

    Args:
        experiment: What would be done, and where.
        connect: See `planned`.
        watch: Is told how far trajectories are that take long to compute.

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
