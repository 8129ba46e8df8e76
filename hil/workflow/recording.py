"""One recorded run: robot, plan, run directory, motion. No fitting in here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hil.core import plugins
from hil.engine import require_room_to_begin
from hil.planning import Experiment, held, plan_for
from hil.recording import RunDirectory
from hil.robot import Robot
from hil.spec import require_judgeable
from hil.workflow.arm_check import require_within_reach
from hil.workflow.attempt import Attempt, Recorded
from hil.workflow.beginning import write_beginning
from hil.workflow.confirmation import Gate, shown_by
from hil.workflow.control_files import hold_attempt
from hil.workflow.execute import Attendance, execute
from hil.workflow.extras import require_extras
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.operator import prompt_on, require_attended


def record(
    experiment: Experiment, *, runs: Path, attendance: Attendance, opened: Robot | None = None
) -> Recorded:
    """Plan, check and execute; leaves a complete run directory however it ends.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        attendance: Who and what attends it.
        opened: The robot, if it is open already.

    Raises:
        SpecError, PlanError, PluginError, RobotError: Before a run directory exists.
        PreflightFailed: It asks for something to be done, and nobody could answer; or the disk has
            no room for what a run begins with.
        NotConfirmed: The robot is a real one, and its motion was not confirmed.
        RecordingError: The run directory cannot be made.
    """
    gate = Gate(experiment, attendance.confirm)
    with held(
        experiment,
        wait_s=attendance.wait_s,
        report=attendance.stage,
        admit=gate.admit,
        robot=opened,
    ) as (robot, lease):
        require_within_reach(experiment, robot.capabilities)
        require_usable(experiment, robot)
        attendance.stage("planning")
        plan = plan_for(experiment, robot, attendance.computing)
        if (part := experiment.commissioning) is not None:
            experiment = replace(experiment, commissioning=part.within(plan))
        require_attended(plan, prompt_on(robot, attendance.prompt))
        interlocks = RunInterlocks(experiment, robot, plan)
        require_room_to_begin(runs)
        confirmed = gate.confirmation(robot, plan)
        if not shown_by(confirmed):
            attendance.planned(plan)
        with attendance.signals.guard():
            directory = RunDirectory.create(
                runs,
                experiment.spec.robot,
                experiment.spec.name,
                begin=lambda draft: write_beginning(
                    draft,
                    experiment,
                    robot,
                    plan,
                    attendance.operator,
                    attendance.waivers,
                    confirmed,
                ),
            )
            attendance.until_judged.enter_context(hold_attempt(directory.path))
            lease.note_run(directory.path)
            attendance.stage(f"running {plan.name} → {directory.path}")
            attempt = Attempt(directory, 0, experiment, plan, plan, interlocks)
            return execute(attempt, robot, attendance)


def require_usable(experiment: Experiment, robot: Robot) -> None:
    """Refuse before any motion what would only fail after hours of it: units and plug-ins.

    A commissioning run is neither fitted nor judged, so it needs none of them.

    Raises:
        SpecError: The criteria are in another unit than the robot's efforts.
        PluginError: An estimator, a study or an extra is missing.
    """
    if experiment.commissioning is not None:
        return
    require_judgeable(experiment.spec, robot.capabilities.effort_kind)
    for fit in experiment.spec.fit:
        plugins.load("hil.estimators", fit.estimator)
    for entry in experiment.spec.study:
        plugins.load("hil.studies", entry.study)
    require_extras(experiment.spec)
