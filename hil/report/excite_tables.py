"""Tables of the page of `hil excite`: condition numbers, and what is left of every limit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.report.blocks import Cell, Column, Table, cells
from hil.report.words import UNKNOWN, joint_title, number

if TYPE_CHECKING:
    from hil.excitation import Information
    from hil.planning import ExcitationReport

DEGREES = 180 / np.pi

TOLERANCE = 1e-9
"""Motions that bind at a limit may exceed it by rounding."""

MARGINS = (
    ("position_rad", "position [°]", DEGREES),
    ("velocity_rad_s", "velocity [°/s]", DEGREES),
    ("acceleration_rad_s2", "acceleration [°/s²]", DEGREES),
    ("jerk_rad_s3", "jerk [°/s³]", DEGREES),
    ("effort_nm", "torque [N·m]", 1.0),
)


def condition_table(report: ExcitationReport) -> Table:
    """Of every trajectory alone, and together with those before it."""
    alone, jointly = "alone", "with those before it"
    columns = (
        Column("trajectory", number=False),
        Column("scaled", alone),
        Column("raw", alone),
        Column("scaled", jointly),
        Column("raw", jointly),
        Column("closest [mm]", "distance"),
        Column("between", "distance", number=False),
        Column("at [s]", "distance"),
    )
    rows = []
    for i, each in enumerate(report.appraisal.trajectories, 1):
        both = [f for one in (each.alone, each.jointly) for f in _condition(one)]
        distance, bodies, at_s = each.closest
        where = (f"{1e3 * distance:.1f}", " and ".join(bodies), f"{at_s:.2f}")
        rows.append(cells(str(i), *both, *where))
    if (random := report.random) is not None:
        best = min((each.alone for each in random.trajectories), key=lambda i: i.condition_scaled)
        which = random.closest[1]
        where = (f"{1e3 * which.distance_m:.1f}", " and ".join(which.bodies), UNKNOWN)
        rows.append(cells("random draws", *_condition(best), *_condition(random.jointly), *where))
    note = "Random draws: the best single one of as many, and all of them jointly."
    return Table("Condition numbers", columns, tuple(rows), note if random is not None else "")


def _condition(information: Information) -> tuple[str, str]:
    return f"{information.condition_scaled:.2f}", f"{information.condition_raw:.1f}"


def margin_table(report: ExcitationReport) -> Table:
    """What is left of every limit, joint by joint."""
    appraisal = report.appraisal
    margins = appraisal.margins
    shown = [each for each in MARGINS if np.isfinite(margins[each[0]]).any()]
    columns = (Column("joint", number=False), *(Column(title) for _, title, _ in shown))
    rows = tuple(
        (
            Cell(joint_title(j, name)),
            *(_margin(float(margins[key][j]), factor) for key, _, factor in shown),
        )
        for j, name in enumerate(appraisal.joint_names)
    )
    share = 100 if report.spec.optimise is None else report.spec.optimise.torque_percent
    note = (
        f"Positions within the range of the excitation; torque to {share:g} % of the arm's limit, "
        f"with the load that needs most. {1e3 * appraisal.limits.clearance_m:g} mm are kept to "
        "everything."
    )
    return Table("What all trajectories leave of each limit", columns, rows, note)


def _margin(value: float, factor: float) -> Cell:
    if value < -TOLERANCE:
        return Cell(number(factor * value), "fail")
    return Cell("0" if value < TOLERANCE else number(factor * value))
