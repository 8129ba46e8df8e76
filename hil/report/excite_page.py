"""The page of `hil excite`: what trajectories tell, what they leave of every limit, how they go."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.report import colours
from hil.report.blocks import (
    Badge,
    Block,
    KeyFigure,
    Page,
    Plots,
    Section,
)
from hil.report.excite_figures import (
    condition_by_number,
    motion_panels,
    singular_values,
    standard_errors,
)
from hil.report.excite_tables import TOLERANCE, condition_table, margin_table
from hil.report.render import write_page
from hil.report.words import duration, joint_title

if TYPE_CHECKING:
    from hil.planning import ExcitationReport

OPEN = 2
"""Trajectories that are open on the page; the others open on a click."""

BOTH = (
    ("these", colours.MEASURED, "●"),
    ("random draws", colours.PREDICTED, "◇"),
    ("equal", colours.NEUTRAL, "dot"),
)


def write_excitation_page(report: ExcitationReport, path: Path) -> Path:
    """Write the page to `path`, replacing an older one whole.

    Raises:
        RecordingError: The file cannot be written.
    """
    return write_page(excitation_page(report), path)


def excitation_page(report: ExcitationReport) -> Page:
    """The page as blocks."""
    appraisal, experiment = report.appraisal, report.experiment
    return Page(
        title=experiment.spec.name,
        subtitle=f"Excitation of {experiment.spec.robot} ({experiment.robot.model})",
        badge=_badge(report),
        summary=_summary(report),
        key_figures=tuple(_key_figures(report)),
        warnings=report.notes,
        sections=(
            _worth(report),
            Section("margins", "Margins", "", (margin_table(report),)),
            *(_trajectory(report, i) for i in range(len(appraisal.trajectories))),
        ),
        footer="Computed from the motions as they would be commanded, not from the search that "
        "found them; torques are those of the nominal rigid body, without friction.",
    )


def _badge(report: ExcitationReport) -> Badge:
    _, closest = report.appraisal.closest
    least = min(float(each.min()) for each in report.appraisal.margins.values())
    within = least >= -TOLERANCE and closest.distance_m >= report.appraisal.limits.clearance_m
    return Badge("within all limits", "pass") if within else Badge("beyond a limit", "fail")


def _summary(report: ExcitationReport) -> str:
    total = len(report.appraisal.trajectories)
    seconds = sum(each.series.duration_s for each in report.appraisal.trajectories)
    asked = report.spec.optimise
    made = "drawn at random" if asked is None else "optimised, each to complement those before it"
    return f"{total} trajectories of {duration(seconds)} together, {made}."


def _key_figures(report: ExcitationReport) -> list[KeyFigure]:
    ours, random = report.appraisal.jointly, report.random
    scaled = f"random draws {random.jointly.condition_scaled:.2f}" if random else ""
    raw = f"random draws {random.jointly.condition_raw:.1f}" if random else ""
    which, closest = report.appraisal.closest
    figures = [
        KeyFigure("condition number, scaled", f"{ours.condition_scaled:.2f}", scaled),
        KeyFigure("condition number, raw", f"{ours.condition_raw:.1f}", raw),
        KeyFigure(
            "closest",
            f"{1e3 * closest.distance_m:.0f} mm",
            f"{' and '.join(closest.bodies)}, trajectory {which + 1}",
        ),
    ]
    if (ratios := report.standard_errors()) is not None:
        middle = float(np.median(list(ratios.values())))
        figures.insert(
            2,
            KeyFigure("standard errors", f"{middle:.2f} ×", "smaller, the parameter in the middle"),
        )
    return figures


def _worth(report: ExcitationReport) -> Section:
    appraisal, random = report.appraisal, report.random
    panels = [condition_by_number(appraisal, random), singular_values(appraisal, random)]
    if random is not None:
        panels.insert(0, standard_errors(appraisal, random))
    lead = (
        f"Of the regressor of all {len(appraisal.jointly.names)} base parameters. Standard errors "
        "say how well parameters are told: those from random draws over those from these "
        "trajectories, for the same noise. A condition number says how evenly they are told, "
        "however well."
    )
    blocks: list[Block] = [
        Plots("Together", lead, tuple(panels), BOTH if random is not None else BOTH[:1]),
        condition_table(report),
    ]
    return Section("worth", "What they tell", "", tuple(blocks))


def _trajectory(report: ExcitationReport, index: int) -> Section:
    appraisal = report.appraisal
    names = [joint_title(j, name) for j, name in enumerate(appraisal.joint_names)]
    trajectory = appraisal.trajectories[index]
    panels = motion_panels(trajectory, appraisal.limits, names)
    legend = tuple(
        (name, colours.of_joint(j), colours.dash_of_joint(j)) for j, name in enumerate(names)
    )
    lead = (
        f"Condition number {trajectory.alone.condition_scaled:.2f} alone, "
        f"{trajectory.jointly.condition_scaled:.2f} with those before it. Positions are shares of "
        "half the range, torques of their limits."
    )
    plots = Plots(
        "Motion", lead, tuple(panels), (*legend, ("limit", colours.NEUTRAL, "dot")), columns=2
    )
    title = f"Trajectory {index + 1}"
    return Section(f"trajectory-{index + 1}", title, "", (plots,), folded=index >= OPEN)
