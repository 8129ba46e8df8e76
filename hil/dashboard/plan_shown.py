"""A plan as pages show it: what it amounts to, what is worth a second look, a picture."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from itertools import starmap
from typing import Any

from hil.core import RobotError
from hil.planning import Commissioning, Experiment, Plan, PlanPreview, moves_for_real, opened
from hil.report import duration, measure, named, picture_of, size
from hil.workflow import (
    WITHOUT_THE_ROBOT,
    MotionFacts,
    Unfinished,
    motion_facts,
    preview_experiment,
    prompts_of,
    remaining_motion,
)

PICTURES = 3
"""Of a long series so many plans are drawn: a picture is some hundred kilobytes."""

UNASKED = (
    "Planned without the robot, which was not connected to: this plan begins in the roomiest pose "
    "of its range, and limits are the maker's; once started, the run plans anew from where the arm "
    "stands, before it moves."
)


def shown_plan(
    experiment: Experiment, part: Commissioning | None, *, draw: bool = True
) -> dict[str, Any]:
    """What an experiment would do; nothing moves.

    Args:
        experiment: What would be run, and where.
        part: What of it; None for all.
        draw: Whether there is a picture, which takes most of a second.

    Raises:
        PlanError: No safe plan follows from the spec, or nothing of it would be measured.
        RobotError: A robot on a virtual clock cannot be asked where it stands.

    Returns:
        What the template shows; `motion` is what has to be confirmed before a real robot moves
        (`MotionFacts.to_dict`), None for mocks and where the robot could not be asked where it
        stands: what it sweeps depends on that.
    """
    experiment = replace(experiment, commissioning=part)
    plan, facts, motion, unreached = _previewed(experiment)
    part = part and part.within(plan)
    return {
        "title": experiment.title,
        "description": experiment.spec.description,
        "rows": list(_rows(facts, part)),
        "interlocks": facts.interlocks,
        "warnings": [text for text in facts.warnings if text != WITHOUT_THE_ROBOT] + unreached,
        "motion": motion and motion.to_dict(),
        "motion_rows": motion.rows() if motion else [],
        "notes": list(_notes(facts, part)),
        "prompts": prompts_of(plan),
        "picture": _picture(plan) if draw else "",
    }


def shown_rest(unfinished: Unfinished) -> dict[str, Any]:
    """Return what going on with a run would do; `motion` and `motion_rows` as in `shown_plan`.

    Raises:
        HilError: It cannot be planned from where the arm stands, see `remaining_motion`.
    """
    motion = remaining_motion(unfinished)
    return {
        "title": f"The rest of {unfinished.experiment.spec.name}",
        "motion": motion and motion.to_dict(),
        "motion_rows": motion.rows() if motion else [],
    }


def _previewed(
    experiment: Experiment,
) -> tuple[Plan, PlanPreview, MotionFacts | None, list[str]]:
    if not moves_for_real(experiment):
        return *preview_experiment(experiment), None, []
    try:
        plan, facts = preview_experiment(experiment, connect=True)
    except RobotError as error:
        message = (
            f"{error.message}. The run can start after it has been planned from the robot's "
            "current position."
        )
        return *preview_experiment(experiment), None, [message]
    with opened(experiment.spec.robot, experiment.robot) as robot:
        return plan, facts, motion_facts(experiment, robot, plan), []


def _rows(facts: PlanPreview, part: Commissioning | None) -> Iterator[tuple[str, str]]:
    if part is not None:
        yield "part of the program", str(part)
    yield "time", duration(facts.duration_s)
    yield from facts.swept.rows()[1:]
    yield "steps", ", ".join(f"{count} {kind}" for kind, count in facts.steps.items())
    yield "poses", str(facts.waypoints)
    yield "recording", size(facts.recording_bytes)
    if part is None:
        yield "condition number", measure(facts.condition_number, "1")
    for name, text in starmap(named, facts.margins.items()):
        yield f"margin: {name}", text


def _notes(facts: PlanPreview, part: Commissioning | None) -> Iterator[str]:
    """In words for somebody who has no command line before them."""
    if part is not None:
        yield "A trial of the arm: nothing is fitted or judged, and it cannot be gone on with."
    if WITHOUT_THE_ROBOT in facts.warnings:
        yield UNASKED


def _picture(plan: Plan) -> str:
    """As an image in the page: nothing in it can run, and its style stays its own."""
    data = base64.b64encode(picture_of(plan).encode()).decode()
    return f"data:image/svg+xml;base64,{data}"
