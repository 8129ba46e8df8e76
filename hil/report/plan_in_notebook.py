"""A plan in a notebook: what it amounts to, what is smallest of its margins, and its picture."""

from __future__ import annotations

import math

from hil.core import card, number
from hil.planning import Plan, preview
from hil.report.plan_figure import picture_of


def plan_card(plan: Plan) -> str:
    """HTML for `Plan._repr_html_`."""
    told = preview(plan)
    margins = plan.margins
    clear = margins.get("clearance_m", math.nan)
    facts = {
        "robot": plan.robot_model,
        "takes": f"{plan.duration_s:.0f} s",
        "steps": ", ".join(f"{count} {kind}" for kind, count in told.steps.items()),
        "clearance": "" if math.isnan(clear) else f"{1000 * clear:.0f} mm",
        "to position limits": f"{math.degrees(margins['position_rad']):.0f}°"
        if "position_rad" in margins
        else "",
        "condition number": number(plan.condition_number),
        "hash": plan.hash[:12],
    }
    return card("Plan", plan.name, facts, picture=picture_of(plan), notes=told.warnings)
