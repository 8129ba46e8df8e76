"""One self-contained SVG that shows what a plan does: `hil plan SPEC --picture FILE`.

It follows the viewer's light or dark setting. Colours are those of Okabe and Ito (2008); nothing
is told by colour alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.core import FloatArray, write_replacing
from hil.excitation import Line
from hil.planning import Plan, preview
from hil.report import svg
from hil.report.plan_figure_style import STYLE
from hil.report.plan_timeline import Span, Timeline, timeline_of

WIDTH, LEFT, RIGHT = 1200.0, 170.0, 1170.0
STRIP = 62.0
CLOSE_UP_S = 40.0
CLOSE_UP_POINTS = 1500
TRAJECTORY_POINTS = 120
VIEW = 300.0
UNIT = {"deg": "°", "speed": "°/s", "acceleration": "°/s²"}


def plan_picture(plan: Plan, path: Path) -> Path:
    """Write the picture of `plan` to `path` (.svg), replacing an older one; return the path.

    From top to bottom: every joint over the whole plan with the measured positions marked, a close
    look at the first measurements, peak speed and acceleration against their limits, and where the
    flange is measured, from above and from the side.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_replacing(path, picture_of(plan).encode())
    return path


def picture_of(plan: Plan) -> str:
    """The same as the text of an SVG."""
    timeline = timeline_of(plan)
    n = len(plan.joint_names)
    y_close = 110.0 + n * STRIP + 70.0
    y_bottom = y_close + 330.0
    height = y_bottom + VIEW + 90.0
    parts = [
        svg.tag("title", f"Plan {plan.name}"),
        svg.tag("style", STYLE),
        svg.tag("rect", class_="page", width=WIDTH, height=height),
        _heading(plan),
        _overview(plan, timeline, 110.0),
        _close_up(plan, timeline, y_close),
        _peaks(plan, y_bottom),
        _views(plan, timeline, y_bottom),
    ]
    frame = {"xmlns": "http://www.w3.org/2000/svg", "viewBox": f"0 0 {WIDTH:g} {height:g}"}
    return svg.tag("svg", "\n".join(parts), role="img", **frame) + "\n"


def _heading(plan: Plan) -> str:
    facts = preview(plan)
    counts = facts.steps
    told = [
        f"{facts.waypoints} poses, {counts['dwell']} dwells" if "dwell" in counts else "",
        f"{counts['trajectory']} trajectories" if "trajectory" in counts else "",
        f"{counts['reference']} reference dwells" if "reference" in counts else "",
        f"{counts['weigh']} weighing dwells" if "weigh" in counts else "",
        f"{facts.duration_s / 60:.1f} min",
        f"about {facts.recording_bytes / 1e6:.0f} MB",
        _condition(facts.condition_number),
        f"plan {facts.hash[:12]}",
    ]
    return svg.text(30, 42, plan.name, class_="title") + svg.text(
        30, 66, " · ".join(filter(None, [plan.robot_model, *told])), class_="soft"
    )


def _condition(number: float) -> str:
    return f"condition number {number:.1f}" if np.isfinite(number) else "condition number infinite"


def _overview(plan: Plan, timeline: Timeline, top: float) -> str:
    """A strip per joint over the whole plan."""
    minutes = timeline.duration_s > 180
    unit_s = 60.0 if minutes else 1.0
    x = svg.Scale(0.0, timeline.duration_s / unit_s, LEFT, RIGHT)
    n = len(plan.joint_names)
    bottom = top + n * STRIP
    parts = [svg.text(30, top - 14, "Joint angles over the whole plan", class_="head")]
    for joint, name in enumerate(plan.joint_names):
        parts.append(_strip(timeline, joint, name, top + joint * STRIP, x, unit_s))
    for at in x.ticks(10):
        parts.append(svg.tag("path", class_="grid", d=f"M{float(x(at)):.1f} {top}V{bottom}"))
        parts.append(_tick_x(float(x(at)), bottom, f"{at:g}"))
    parts.append(
        svg.text(RIGHT, bottom + 36, "time [min]" if minutes else "time [s]", class_="axis end")
    )
    return svg.group(parts)


def _strip(
    timeline: Timeline, joint: int, name: str, top: float, x: svg.Scale, unit_s: float
) -> str:
    angles = np.degrees(timeline.q[:, joint])
    low, high = _round_range(angles)
    y = svg.Scale(low, high, top + STRIP - 8, top + 4)
    t, shown = svg.thinned(timeline.t / unit_s, angles, int(RIGHT - LEFT))
    marks_t, marks = timeline.marks(joint)
    measured = [
        svg.line(x(piece_t / unit_s), y(np.degrees(piece)))
        for piece_t, piece in timeline.trajectories(joint, TRAJECTORY_POINTS)
    ]
    return svg.group(
        [
            svg.tag("path", class_="base", d=f"M{LEFT} {top + STRIP - 8}H{RIGHT}"),
            svg.text(30, top + 28, _short(joint, name), class_="label"),
            svg.text(LEFT - 8, top + 14, f"{high:g}°", class_="axis end"),
            svg.text(LEFT - 8, top + STRIP - 8, f"{low:g}°", class_="axis end"),
            svg.tag("path", class_="motion", d=svg.line(x(t), y(shown))),
            svg.tag("path", class_="measured", d="".join(measured)),
            svg.tag("path", class_="mark", d=svg.dots(x(marks_t / unit_s), y(np.degrees(marks)))),
        ]
    )


def _close_up(plan: Plan, timeline: Timeline, top: float) -> str:
    """All joints over the first measurements, dwells as bands."""
    begin, end = timeline.close_up(CLOSE_UP_S)
    inside = (timeline.t >= begin) & (timeline.t <= end)
    x = svg.Scale(begin, end, LEFT, RIGHT)
    angles = np.degrees(timeline.q[inside])
    y = svg.Scale(*_round_range(angles), top + 240.0, top + 20.0)
    parts = [
        svg.text(30, top - 14, "A closer look: the first measurements", class_="head"),
        svg.text(RIGHT, top - 14, _key_to_bands(timeline), class_="axis end"),
    ]
    parts += [_band(span, x, top) for span in timeline.spans if begin <= span.begin < end]
    for at in y.ticks(5):
        parts.append(svg.tag("path", class_="grid", d=f"M{LEFT} {float(y(at)):.1f}H{RIGHT}"))
        parts.append(svg.text(LEFT - 8, float(y(at)) + 4, f"{at:g}°", class_="axis end"))
    parts += [_tick_x(float(x(at)), top + 240.0, f"{at:g}") for at in x.ticks(10)]
    for joint, name in enumerate(plan.joint_names):
        every = max(1, int(inside.sum()) // CLOSE_UP_POINTS)
        d = svg.line(x(timeline.t[inside][::every]), y(angles[::every, joint]))
        parts.append(svg.tag("path", class_=f"joint j{joint % 7}", d=d))
        parts.append(_key(joint, name, LEFT + 155.0 * joint, top + 282.0))
    parts.append(svg.text(RIGHT, top + 276, "time [s]", class_="axis end"))
    return svg.group(parts)


def _key_to_bands(timeline: Timeline) -> str:
    kinds = {span.step.kind for span in timeline.spans}
    if "trajectory" in kinds:
        return "shaded: a trajectory is measured"
    return "shaded: measured at rest, ▲ arrived from below, ▼ from above"


def _band(span: Span, x: svg.Scale, top: float) -> str:
    left, right = float(x(span.begin)), min(float(x(span.end)), RIGHT)
    sign = {1: "▲", -1: "▼"}.get(span.approach, "")
    kind = {1: "up", -1: "down"}.get(span.approach, "level")
    band = svg.tag(
        "rect", class_=f"band {kind}", x=left, y=top + 20.0, width=right - left, height=220.0
    )
    return band + (
        svg.text((left + right) / 2, top + 14, sign, class_=f"sign {kind}") if sign else ""
    )


def _key(joint: int, name: str, x: float, y: float) -> str:
    drawn = svg.tag("path", class_=f"joint j{joint % 7}", d=f"M{x} {y - 4}h28")
    return drawn + svg.text(x + 34, y, _short(joint, name), class_="axis")


def _peaks(plan: Plan, top: float) -> str:
    """Peak speed and acceleration of each joint as a share of the plan's limits."""
    goes = plan.extremes
    limits = _limits(plan)
    x = svg.Scale(0.0, 1.0, LEFT, LEFT + 330.0)
    parts = [svg.text(30, top - 14, "Peaks against the plan's limits", class_="head")]
    row = VIEW / len(plan.joint_names)
    for joint, name in enumerate(plan.joint_names):
        y = top + joint * row
        parts.append(svg.text(30, y + row / 2 + 4, _short(joint, name), class_="label"))
        for k, (kind, peak) in enumerate(
            (("speed", goes.qd_max[joint]), ("acceleration", goes.qdd_max[joint]))
        ):
            share, height = min(float(peak) / limits[k], 1.0), row * 0.32
            at = y + row * (0.12 + 0.4 * k)
            width = float(x(share)) - LEFT
            parts.append(
                svg.tag("rect", class_=f"bar {kind}", x=LEFT, y=at, width=width, height=height)
            )
            told = f"{np.degrees(peak):.1f} {UNIT[kind]}"
            parts.append(svg.text(LEFT + 8, at + height - 2.5, told, class_="inbar"))
    end = float(x(1.0))
    parts.append(svg.tag("path", class_="limit", d=f"M{end:.1f} {top}v{VIEW}"))
    speed, acceleration = np.degrees(limits)
    told = f"limit: {speed:.0f} °/s, {acceleration:.0f} °/s²"
    parts.append(svg.text(end, top + VIEW + 20, told, class_="axis end"))
    return svg.group(parts)


def _limits(plan: Plan) -> tuple[float, float]:
    """Speed and acceleration limits of the plan's moves [rad/s, rad/s²]."""
    lines = [motion for motion in plan.motions if isinstance(motion, Line)]
    if lines:
        return lines[0].velocity, lines[0].acceleration
    return float(plan.extremes.qd_max.max()), float(plan.extremes.qdd_max.max())


def _views(plan: Plan, timeline: Timeline, top: float) -> str:
    """Where the flange is measured."""
    places = timeline.flange_places(plan)
    if not len(places):
        return ""
    reach = 1.08 * float(np.abs(places).max())
    above = _view(places[:, [0, 1]], reach, 540.0, top, ("x", "y"), "From above")
    side = _view(places[:, [0, 2]], reach, 870.0, top, ("x", "z"), "From the side")
    return above + side


def _view(
    places: FloatArray,
    reach: float,
    left: float,
    top: float,
    axes: tuple[str, str],
    head: str,
) -> str:
    x = svg.Scale(-reach, reach, left, left + VIEW)
    y = svg.Scale(-reach, reach, top + VIEW, top)
    zero = float(x(0.0)), float(y(0.0))
    parts = [
        svg.text(left, top - 14, head, class_="head"),
        svg.tag("rect", class_="frame", x=left, y=top, width=VIEW, height=VIEW),
        svg.tag(
            "path", class_="grid", d=f"M{zero[0]:.1f} {top}v{VIEW}M{left} {zero[1]:.1f}h{VIEW}"
        ),
        svg.tag("path", class_="place", d=svg.dots(x(places[:, 0]), y(places[:, 1]))),
        svg.tag("circle", class_="foot", cx=zero[0], cy=zero[1], r=7),
        svg.text(left + VIEW, top + VIEW + 36, f"{axes[0]} [m]", class_="axis end"),
        svg.text(left + 6, top + 16, f"{axes[1]} [m]", class_="axis"),
    ]
    parts += [_tick_x(float(x(at)), top + VIEW, f"{at:g}") for at in x.ticks(4)]
    return svg.group(parts)


def _round_range(degrees: FloatArray) -> tuple[float, float]:
    low, high = np.floor(degrees.min() / 30), np.ceil(degrees.max() / 30)
    return 30 * float(low) + 0.0, 30 * float(max(high, low + 1)) + 0.0


def _tick_x(x: float, y: float, words: str) -> str:
    return svg.text(x, y + 18, words, class_="axis middle")


def _short(joint: int, name: str) -> str:
    return f"{joint + 1} {name.removesuffix('_joint').replace('_', ' ')}"
