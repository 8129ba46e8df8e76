"""The section about the motion: joint angles, pose map, position–velocity coverage."""

from __future__ import annotations

import numpy as np

from hil.report.documents import as_float, as_index, as_object
from hil.report.facts import RunFacts
from hil.report.page import Block, Facts, Section, items
from hil.report.run_figures import RunView, figures_of
from hil.report.words import number, with_unit_apart


def excitation(view: RunView) -> Section:
    """Where the arm went, from the recorded positions."""
    blocks: list[Block] = [_plan(view.facts), *figures_of("excitation", view)]
    lead = "Where the arm went, from the recorded positions."
    return Section("excitation", "Excitation", lead, tuple(blocks))


def _plan(facts: RunFacts) -> Facts:
    kinds = [str(step.get("kind")) for step in facts.steps]
    poses = {as_index(step.get("pose")) for step in facts.steps if step.get("kind") == "dwell"}
    said: dict[str, object] = {
        "steps": f"{facts.steps_done} of {len(kinds)} done" if kinds else None,
        "poses": len(poses) or None,
        "dwells": kinds.count("dwell") or None,
        "trajectories": kinds.count("trajectory") or None,
        "reference visits": kinds.count("reference") or None,
    }
    condition = as_float(facts.plan.get("condition_number"))
    if np.isfinite(condition):
        said["condition number of the regressor"] = number(condition)
    for name, value in as_object(facts.plan.get("margins")).items():
        said[f"margin: {with_unit_apart(name)}"] = number(as_float(value))
    return Facts("Plan", items(said))
