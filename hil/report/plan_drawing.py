"""Picture of a plan for `hil plan SPEC --picture FILE`, for notebooks and for the dashboard.

The picture is one self-contained SVG that follows the light or dark mode of the viewer. From top to
bottom, the picture shows: every joint over the whole plan with the measured positions marked; a
close-up of the first measurements; peak speed and acceleration relative to their limits; the
measured flange positions from above and from the side.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hil.core import FloatArray, card, number, write_replacing
from hil.dynamics import load_model
from hil.excitation import Line
from hil.planning import Plan, Step, preview, recording_bytes
from hil.report import colours
from hil.report.curves import decimated, dressed
from hil.report.matplotlib_figure import draw, following_the_screen, on_sheet
from hil.studies import Axis, Curve, Figure, Look, Panel, Span

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Sheet

WIDTH = 240.0
STRIP, HEADING, CLOSE_UP, VIEWS = 14.0, 12.0, 62.0, 84.0
"""Heights of the parts of a plan picture [mm]."""

CLOSE_UP_S = 40.0
POINTS = 1500
TRAJECTORY_POINTS = 120
PLACES = 2000
"""Maximum number of flange positions that are drawn."""

MOTION = Look(colours.NEUTRAL, width=0.6)


def plan_picture(plan: Plan, path: Path) -> Path:
    """Write the picture of `plan` to `path` (.svg), replacing an older file, and return the path.

    Raises:
        RecordingError: The picture file cannot be written.
    """
    write_replacing(path, picture_of(plan).encode())
    return path


def picture_of(plan: Plan) -> str:
    """Return the picture of a plan as the text of an SVG file."""
    timeline = timeline_of(plan)
    figures = [figure for make in PARTS if (figure := make(plan, timeline)).panels]
    tall = [STRIP * len(plan.joint_names) + 16, CLOSE_UP, VIEWS][: len(figures)]

    def together(sheet: Sheet) -> None:
        sheet.suptitle("\n".join(_heading(plan)), x=0.01, ha="left", fontsize=8)
        parts = sheet.subfigures(len(figures), 1, height_ratios=tall, squeeze=False).ravel()
        for part, figure in zip(parts, figures, strict=True):
            part.suptitle(figure.title, x=0.01, ha="left", fontsize=7.5)
            draw(part, dressed(figure, 800), WIDTH, "outside lower center")

    return following_the_screen(on_sheet(together, WIDTH, HEADING + sum(tall), "svg", text=True))


def plan_card(plan: Plan) -> str:
    """Return the HTML that `Plan._repr_html_` returns."""
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


def _heading(plan: Plan) -> tuple[str, str]:
    counts = Counter(step.kind for step in plan)
    condition = plan.condition_number
    told = [
        plan.robot_model,
        f"{plan.waypoints} poses, {counts['dwell']} dwells" if "dwell" in counts else "",
        f"{counts['trajectory']} trajectories" if "trajectory" in counts else "",
        f"{counts['reference']} reference dwells" if "reference" in counts else "",
        f"{counts['weigh']} weighing dwells" if "weigh" in counts else "",
        f"{plan.duration_s / 60:.1f} min",
        f"about {recording_bytes(plan) / 1e6:.0f} MB",
        f"condition number {f'{condition:.1f}' if np.isfinite(condition) else 'infinite'}",
        f"plan {plan.hash[:12]}",
    ]
    return plan.name, " · ".join(filter(None, told))


def overview(plan: Plan, timeline: Timeline) -> Figure:
    """Return the figure of the whole plan with one strip per joint."""
    minutes = timeline.duration_s > 180
    unit_s = 60.0 if minutes else 1.0
    dots = Look(colours.MEASURED, size=2.6, opacity=1.0)

    def strip(joint: int, name: str) -> Panel:
        angles = np.degrees(timeline.q[:, joint])
        t, shown = decimated(timeline.t / unit_s, angles, POINTS)
        curves = [Curve("motion", t, shown, look=MOTION)]
        for at, piece in timeline.trajectories(joint, TRAJECTORY_POINTS):
            curves.append(Curve("measured", at / unit_s, np.degrees(piece), look=dots))
        at, held = timeline.dwells(joint)
        if len(at):
            curves.append(Curve("measured", at / unit_s, np.degrees(held), "points", look=dots))
        limits = (30 * math.floor(angles.min() / 30), 30 * math.ceil(angles.max() / 30))
        limits = (limits[0], max(limits[1], limits[0] + 30))
        axes = ("time [min]" if minutes else "time [s]", "joint angle [°]")
        whole = Axis(limits=(0.0, timeline.duration_s / unit_s))
        y_axis = Axis(limits=limits)
        named = _short(joint, name)
        return Panel("", *axes, tuple(curves), named, x_axis=whole, y_axis=y_axis)

    panels = tuple(strip(joint, name) for joint, name in enumerate(plan.joint_names))
    return Figure("plan", "Joint angles over the whole plan", "", panels, 1)


def close_up(plan: Plan, timeline: Timeline) -> Figure:
    """Return the figure of all joints over the first measurements, with shaded spans."""
    begin, end = timeline.close_up(CLOSE_UP_S)
    inside = (timeline.t >= begin) & (timeline.t <= end)
    curves = []
    for joint, name in enumerate(plan.joint_names):
        t, angle = decimated(timeline.t[inside], np.degrees(timeline.q[inside, joint]), POINTS)
        curves.append(Curve(_short(joint, name), t, angle, look=colours.of_joint(joint)))
    measured = (span for span in timeline.spans if begin <= span.begin < end)
    spans = tuple(Span(one.begin, min(one.end, end), one.approach) for one in measured)
    axes = ("time [s]", "joint angle [°]")
    panel = Panel("", *axes, tuple(curves), x_axis=Axis(limits=(begin, end)), spans=spans)
    moving = any(span.step.kind == "trajectory" for span in timeline.spans)
    shaded = "a trajectory is measured" if moving else (
        "dwells, ▲ approached from below, ▼ from above"
    )  # fmt: skip
    title = f"The first measurements; shaded: {shaded}"
    return Figure("close-up", title, "", (panel,), 1)


def peaks_and_places(plan: Plan, timeline: Timeline) -> Figure:
    """Return the figure of peak speed and acceleration per joint, and of flange positions."""
    panels = [_peaks(plan)]
    places = timeline.flange_places(plan)
    if len(places):
        panels += [
            _view("Flange from above", places[:, 0], places[:, 1], "y [m]"),
            _view("Flange from the side", places[:, 0], places[:, 2], "z [m]"),
        ]
    return Figure("peaks", "Peaks relative to the limits of the plan; measured positions", "",
                  tuple(panels), 3)  # fmt: skip


PARTS = (overview, close_up, peaks_and_places)
"""Functions that create the parts of the plan picture, from top to bottom."""


def _peaks(plan: Plan) -> Panel:
    lines = [motion for motion in plan.motions if isinstance(motion, Line)]
    goes = plan.extremes
    limits = (
        (lines[0].velocity, lines[0].acceleration)
        if lines
        else (float(goes.qd_max.max()), float(goes.qdd_max.max()))
    )
    joints = tuple(f"J{j + 1}" for j in range(len(plan.joint_names)))
    curves = tuple(
        Curve(kind, joints, 100 * np.minimum(np.asarray(peak) / limit, 1.0), "bars")
        for kind, peak, limit in zip(
            ("speed", "acceleration"), (goes.qd_max, goes.qdd_max), limits, strict=True
        )
    )
    speed, acceleration = np.degrees(limits)
    title = f"limit: {speed:.0f} °/s, {acceleration:.0f} °/s²"
    y_axis = Axis(limits=(0.0, 105.0))
    return Panel(title, "joint", "peak, of the limit [%]", curves, y_axis=y_axis)


def _view(title: str, x: FloatArray, y: FloatArray, y_title: str) -> Panel:
    reach = 1.08 * float(max(np.abs(x).max(), np.abs(y).max()))
    axis = Axis(limits=(-reach, reach))
    dots = Look(colours.MEASURED, size=4, opacity=0.65)
    foot = Look(colours.NEUTRAL, symbol="square-open", size=9, opacity=1.0)
    curves = (
        Curve("measured", x, y, "points", look=dots),
        Curve("foot of the arm", [0.0], [0.0], "points", look=foot),
    )
    return Panel(title, "x [m]", y_title, curves, x_axis=axis, y_axis=axis, square=True)


def _short(joint: int, name: str) -> str:
    return f"{joint + 1} {name.removesuffix('_joint').replace('_', ' ')}"


class Measured(NamedTuple):
    """Measuring step of a plan from time `begin` to time `end` [s], with its approach direction."""

    begin: float
    end: float
    approach: int
    step: Step


@dataclass(frozen=True, eq=False)
class Timeline:
    """Motion of a plan over the estimated time.

    Attributes:
        t: (N,) time [s].
        q: (N, n) joint angles [rad].
        spans: Measuring steps of the plan in order.
        duration_s: Estimated duration of the whole plan [s].
    """

    t: FloatArray
    q: FloatArray
    spans: tuple[Measured, ...]
    duration_s: float

    def dwells(self, joint: int) -> tuple[FloatArray, FloatArray]:
        """Return time [s] and angle [rad] of one joint in every dwell."""
        held = [span for span in self.spans if span.step.kind in ("dwell", "reference")]
        times = np.array([(span.begin + span.end) / 2 for span in held])
        angles = [span.step.motion.q_end[joint] for span in held if span.step.motion]
        return times, np.array(angles)

    def trajectories(self, joint: int, points: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield time [s] and angle [rad] of one joint along each trajectory.

        Args:
            joint: Index of the joint.
            points: Approximate number of points per trajectory.
        """
        for span in self.spans:
            if span.step.kind == "trajectory" and span.step.motion is not None:
                samples = span.step.motion.sample(points / (span.end - span.begin))
                yield span.begin + samples.t, samples.q[:, joint]

    def close_up(self, length_s: float) -> tuple[float, float]:
        """Return the start and the end of the close-up [s].

        The close-up shows the first trajectory, or `length_s` from the start of the first dwell.
        """
        if not self.spans:
            return 0.0, self.duration_s
        first = next((s for s in self.spans if s.step.kind == "trajectory"), self.spans[0])
        length = max(length_s, first.end - first.begin)
        return max(0.0, first.begin - 1.0), min(self.duration_s, first.begin - 1.0 + length)

    def flange_places(self, plan: Plan) -> FloatArray:
        """Return about `PLACES` flange positions [m] at measured poses, (M, 3)."""
        measured = [span.step.motion for span in self.spans if span.step.motion]
        if not measured:
            return np.empty((0, 3))
        q = np.concatenate([m.sample(plan.rate_hz).q for m in dict.fromkeys(measured)])
        thinned = q[:: max(1, len(q) // PLACES)]
        return load_model(plan.robot_model).flange_pose(thinned)[:, :3, 3]


def timeline_of(plan: Plan) -> Timeline:
    """Return the motion of a plan over estimated time, including the estimated time of dwells."""
    times, positions, spans = [np.zeros(1)], [plan.q_start[None]], list[Measured]()
    now = 0.0
    for step in plan:
        if step.motion is None:
            continue
        length = plan.step_duration_s(step)
        if step.measures:
            spans.append(Measured(now, now + length, step.approach, step))
        samples = step.motion.sample(plan.rate_hz)
        times.append(now + samples.t if len(samples) > 1 else np.array([now + length]))
        positions.append(samples.q)
        now += length
    return Timeline(np.concatenate(times), np.concatenate(positions), tuple(spans), now)
