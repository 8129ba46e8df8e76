"""What an experiment would do and who would watch it, before anything moves."""

from __future__ import annotations

from pathlib import Path

from hil.campaign.experiment import Experiment
from hil.campaign.interlocks import interlocks_for
from hil.campaign.robots import connected, plan_for
from hil.plan.plan import Plan
from hil.plan.preview import PlanPreview, preview


def preview_experiment(experiment: Experiment) -> tuple[Plan, PlanPreview]:
    """The plan from where the robot stands now, and what it amounts to; nothing moves.

    Raises:
        PlanError: No safe plan follows from the spec, or an interlock cannot be judged.
    """
    with connected(experiment.spec.robot, experiment.robot) as robot:
        plan = plan_for(experiment, robot)
        watching = interlocks_for(experiment, robot, plan, folder=Path(), behind_s=lambda: 0.0)
    return plan, preview(plan, watching.describe())
