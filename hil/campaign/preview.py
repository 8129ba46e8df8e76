"""What an experiment would do and who would watch it, before anything moves."""

from __future__ import annotations

from pathlib import Path

from hil.campaign.experiment import Experiment
from hil.campaign.extras import missing_extras
from hil.campaign.interlocks import interlocks_for
from hil.campaign.robots import planned
from hil.excite.setting import Watch, unwatched
from hil.plan.plan import Plan
from hil.plan.preview import PlanPreview, preview

WITHOUT_THE_ROBOT = (
    "planned without the robot, which was not connected to: the plan begins in the roomiest pose "
    "of its range, and limits are the maker's; `hil run` plans from where the arm stands, and so "
    "does `hil plan --connect`"
)


def preview_experiment(
    experiment: Experiment, *, connect: bool = False, watch: Watch = unwatched
) -> tuple[Plan, PlanPreview]:
    """The plan and what it amounts to; nothing moves.

    Args:
        experiment: What would be done, and where.
        connect: See `hil.campaign.robots.planned`.
        watch: Is told how far trajectories are that take long to compute.

    Raises:
        SpecError: The arm cannot do it, or it would give no result.
        PlanError: No safe plan follows from the spec, or an interlock cannot be judged.
        RobotError: The robot cannot be asked where it stands.
    """
    with planned(experiment, connect=connect, watch=watch) as (robot, plan, from_where_it_stands):
        watching = interlocks_for(experiment, robot, plan, folder=Path(), behind_s=lambda: 0.0)
    unasked = () if from_where_it_stands else (WITHOUT_THE_ROBOT,)
    lacking = missing_extras(experiment.spec) if experiment.commissioning is None else ()
    return plan, preview(plan, watching.describe(), (*unasked, *lacking))
