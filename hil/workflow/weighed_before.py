"""What the first load of a run weighed in earlier attempts, by their recordings.

A weighing counts once its attempt went on past it: one that was refused, or given up, says nothing
about the load that was measured with.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from hil.core import DataError, StructArray
from hil.importers import recorded_steps, step_is_complete
from hil.planning import Plan, Step, why_plan_not_weighed
from hil.robot import Capabilities
from hil.workflow.scales import Reading, gains_of, reading_of

Readings = dict[int, Reading | str]
"""Weighing dwell → what it says, or why it says nothing."""


def weighed_before(plan: Plan, recordings: Iterable[Path], robot: Capabilities) -> Readings:
    """The first load's weighing dwells in the newest attempt whose weighing counts.

    Args:
        plan: Of the whole run.
        recordings: `RunDirectory.recordings`.
        robot: What its efforts are, and its drive gains.

    Returns:
        Nothing when no attempt went on past it, or nothing is weighed in this run. Reasons only
        when none of those that did can be read.

    Raises:
        DataError: A recording is no MCAP file at all, or of a newer hil.
    """
    steps = {step.index: step for step in plan if step.kind == "weigh" and step.load == 0}
    if why_plan_not_weighed(plan, robot):
        return {}
    past = {step.index for step in plan if step.measures or step.load}
    found: Readings = {}
    for rows, seen in recorded_steps(recordings, steps):
        # An attempt under later loads alone had no need to weigh the first one.
        if seen.isdisjoint(past) or (found and not rows):
            continue
        own = {index: _reading(plan, steps[index], rows, robot) for index in steps}
        if is_whole(own) or not is_whole(found):
            found = own
    return found


def is_whole(readings: Mapping[int, Reading | str]) -> bool:
    """Whether there are readings and each of them can be relied on."""
    return bool(readings) and not any(isinstance(one, str) for one in readings.values())


def _reading(
    plan: Plan, step: Step, recorded: Mapping[int, StructArray], robot: Capabilities
) -> Reading | str:
    rows = recorded.get(step.index)
    if rows is None:
        return "nothing was recorded"
    if not step_is_complete(step, rows, plan):
        return "the recording is torn"
    rule = plan.dwell_rule(step)
    try:
        return reading_of(rows[-rule.samples :], gains_of(robot), rule.settle_rad_s)
    except DataError as error:
        return error.message
