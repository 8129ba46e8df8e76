"""Page of `hil optimise`: condition number, margins and motion of excitation trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray
from hil.excitation import Appraisal, Limits, Trajectory
from hil.report import colours
from hil.report.curves import decimated
from hil.report.page import (
    Badge,
    Block,
    Cell,
    Column,
    KeyFigure,
    Page,
    Section,
    Table,
    cells,
    write_page,
)
from hil.report.run_figures import limit_line
from hil.report.words import UNKNOWN, duration, joint_title, number
from hil.studies import Axis, Curve, Figure, Look, Panel

if TYPE_CHECKING:
    from hil.excitation import Information
    from hil.planning import ExcitationReport

DEGREES = 180 / np.pi

OPEN = 2
"""Number of trajectories whose sections are initially open."""

POINTS = 240
"""Maximum number of points of a line in this page.

The maximum is low because a page with twelve trajectories contains hundreds of lines.
"""

TOLERANCE = 1e-9
"""Tolerance for limit violations, because a motion at its limit possibly exceeds the limit by a
rounding error.
"""


def write_excitation_page(report: ExcitationReport, path: Path) -> Path:
    """Write the page of an excitation report to `path`, replacing an older page atomically.

    Raises:
        RecordingError: The page cannot be written.
    """
    return write_page(excitation_page(report), path)


def excitation_page(report: ExcitationReport) -> Page:
    """Return the page of an excitation report."""
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
        footer="Computed from the motions as they would be commanded, not copied from the "
        "optimisation. Torques are those of the nominal rigid-body model without friction.",
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
    made = "drawn at random" if asked is None else "each optimised to complement those before it"
    return f"{total} trajectories of {duration(seconds)} in total, {made}."


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
            KeyFigure(
                "standard errors", f"{middle:.2f} ×", "smaller than random draws (median parameter)"
            ),
        )
    return figures


def _worth(report: ExcitationReport) -> Section:
    appraisal, random = report.appraisal, report.random
    panels = [condition_by_number(appraisal, random), singular_values(appraisal, random)]
    if random is not None:
        panels.insert(0, standard_errors(appraisal, random))
    lead = (
        f"Properties of the regressor of all {len(appraisal.jointly.names)} base parameters. "
        "Standard errors show how accurately the parameters are identified: the plot divides those "
        "of random draws by those of these trajectories, for equal noise. The condition number "
        "shows only how evenly the parameters are identified."
    )
    blocks: list[Block] = [
        Figure("together", "Together", lead, tuple(panels), 0),
        condition_table(report),
    ]
    return Section("worth", "Information", "", tuple(blocks))


def standard_errors(appraisal: Appraisal, random: Appraisal) -> Panel:
    """Return a panel with the ratio of standard errors for each parameter.

    The ratio is the standard error of a parameter with random trajectories divided by the standard
    error with the optimised trajectories.
    """
    ratio = random.jointly.standard_errors / appraisal.jointly.standard_errors
    order = np.argsort(ratio)
    names = [appraisal.jointly.names[i].split(" ")[0] for i in order]
    rank = np.arange(1.0, len(order) + 1)
    mark = Look(colours.MEASURED, size=7, opacity=1.0)
    return Panel(
        "Standard errors",
        "parameter, sorted by ratio [1]",
        "random draws / these [1]",
        (
            Curve("equal", rank[[0, -1]], np.ones(2), look=Look(colours.NEUTRAL, "dot")),
            Curve("these", rank, ratio[order], "points", (), mark, names),
        ),
        alt=f"Ratios between {ratio.min():.2f} and {ratio.max():.2f}, "
        f"median {np.median(ratio):.2f}.",
        y_axis=Axis(from_zero=True),
    )


def condition_by_number(appraisal: Appraisal, random: Appraisal | None) -> Panel:
    """Return a panel with the condition number of the first one, two, … trajectories together."""

    def values(whose: Appraisal) -> FloatArray:
        return np.array([each.jointly.condition_scaled for each in whose.trajectories])

    ours = values(appraisal)
    return Panel(
        "Condition number",
        "trajectories [1]",
        "condition, scaled [1]",
        _ranked(ours, None if random is None else values(random)),
        alt=f"Condition number from {ours[0]:.1f} with the first trajectory to {ours[-1]:.1f} with "
        "all of them.",
        x_axis=Axis(whole=True),
    )


def singular_values(appraisal: Appraisal, random: Appraisal | None) -> Panel:
    """Return a panel with the singular values of the scaled regressor of all trajectories."""
    ours = appraisal.jointly.singular_values
    return Panel(
        "Singular values",
        "number, the largest first [1]",
        "singular value, scaled [1]",
        _ranked(ours, None if random is None else random.jointly.singular_values),
        alt=f"{len(ours)} singular values from {ours[0]:.2f} down to {ours[-1]:.2f}.",
        y_axis=Axis("log"),
    )


def _ranked(ours: FloatArray, random: FloatArray | None) -> tuple[Curve, ...]:
    these = Look(colours.MEASURED, width=1.5, size=6)
    theirs = Look(colours.PREDICTED, symbol="diamond-open", width=1.5, size=6)
    pairs = (("these", ours, these), ("random draws", random, theirs))
    return tuple(
        Curve(name, np.arange(1.0, len(values) + 1), values, "marked", look=look)
        for name, values, look in pairs
        if values is not None
    )


MARGINS = (
    ("position_rad", "position [°]", DEGREES),
    ("velocity_rad_s", "velocity [°/s]", DEGREES),
    ("acceleration_rad_s2", "acceleration [°/s²]", DEGREES),
    ("jerk_rad_s3", "jerk [°/s³]", DEGREES),
    ("effort_nm", "torque [N·m]", 1.0),
)


def condition_table(report: ExcitationReport) -> Table:
    """Return a table with the condition numbers of the regressor for every trajectory.

    The condition number of each trajectory is computed alone and together with the preceding
    trajectories.
    """
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
    note = "Random draws: the best of as many single trajectories, and all of them jointly."
    return Table("Condition numbers", columns, tuple(rows), note if random is not None else "")


def _condition(information: Information) -> tuple[str, str]:
    return f"{information.condition_scaled:.2f}", f"{information.condition_raw:.1f}"


def margin_table(report: ExcitationReport) -> Table:
    """Return a table with the margins of the motion to every limit, per joint."""
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
        "Margins of position refer to the range of the excitation. Margins of torque refer to "
        f"{share:g} % of the limit of the arm, with the payload that requires most torque. The "
        f"required distance to all bodies is {1e3 * appraisal.limits.clearance_m:g} mm."
    )
    return Table("Margins of all trajectories to each limit", columns, rows, note)


def _margin(value: float, factor: float) -> Cell:
    if value < -TOLERANCE:
        return Cell(number(factor * value), "fail")
    return Cell("0" if value < TOLERANCE else number(factor * value))


def _trajectory(report: ExcitationReport, index: int) -> Section:
    appraisal = report.appraisal
    trajectory = appraisal.trajectories[index]
    lead = (
        f"Condition number {trajectory.alone.condition_scaled:.2f} alone, "
        f"{trajectory.jointly.condition_scaled:.2f} with the trajectories before it. Positions are "
        "given in percent of half the range, torques in percent of their limits."
    )
    panels = motion_panels(trajectory, appraisal.limits, appraisal.joint_names)
    motion = Figure("motion", "Motion", lead, tuple(panels), 2)
    title = f"Trajectory {index + 1}"
    return Section(f"trajectory-{index + 1}", title, "", (motion,), folded=index >= OPEN)


def motion_panels(trajectory: Trajectory, limits: Limits, names: Sequence[str]) -> list[Panel]:
    """Return panels of position, velocity, acceleration, jerk, torque and distance, with limits."""
    samples = trajectory.samples
    half = (limits.q_max - limits.q_min) / 2
    centred = (samples.q - (limits.q_max + limits.q_min) / 2) / half
    largest = np.abs(trajectory.effort).argmax(axis=0)
    effort = np.take_along_axis(trajectory.effort, largest[None], axis=0)[0]
    shown = [
        ("Position", "position in the range [%]", 100 * centred, 100.0),
        ("Velocity", "velocity [°/s]", DEGREES * samples.qd, DEGREES * limits.velocity[0]),
        (
            "Acceleration",
            "acceleration [°/s²]",
            DEGREES * samples.qdd,
            DEGREES * limits.acceleration[0],
        ),
        ("Torque", "torque, of the limit [%]", 100 * effort / limits.effort, 100.0),
    ]
    if np.isfinite(limits.jerk[0]):
        jerk = DEGREES * trajectory.jerk
        shown.insert(3, ("Jerk", "jerk [°/s³]", jerk, DEGREES * limits.jerk[0]))
    panels = [
        _motion_panel(title, y_title, samples.t, values, float(limit), names)
        for title, y_title, values, limit in shown
    ]
    return [*panels, _distance(trajectory, limits.clearance_m)]


def _motion_panel(
    title: str,
    y_title: str,
    t: FloatArray,
    values: FloatArray,
    limit: float,
    names: Sequence[str],
) -> Panel:
    curves = []
    for j, name in enumerate(names):
        x, y = decimated(t, values[:, j], POINTS)
        look = replace(colours.of_joint(j), width=1.5)
        curves.append(Curve(joint_title(j, name), x, y, look=look))
    limits = [limit_line(t[[0, -1]], side * limit) for side in (1, -1)]
    peaks = np.abs(values).max(axis=0)
    most = int(peaks.argmax())
    said = (
        f"{title} over time; the largest value is {peaks[most]:.0f} "
        f"({joint_title(most, names[most])})."
    )
    return Panel(title, "time [s]", y_title, (*curves, *limits), alt=said)


def _distance(trajectory: Trajectory, kept_m: float) -> Panel:
    t = trajectory.samples.t
    x, y = decimated(t, 1e3 * trajectory.clearance, POINTS)
    distance, bodies, at_s = trajectory.closest
    return Panel(
        "Distance",
        "time [s]",
        "distance [mm]",
        (
            Curve("", x, y, look=Look(colours.RESIDUAL)),
            limit_line(t[[0, -1]], 1e3 * kept_m),
        ),
        alt=f"Smallest distance {1e3 * distance:.1f} mm, between {' and '.join(bodies)}, at "
        f"{at_s:.2f} s.",
        y_axis=Axis(from_zero=True),
    )
