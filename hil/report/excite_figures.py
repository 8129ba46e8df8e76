"""Figures about trajectories before they are driven: motions under their limits, what they tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil.excitation import Appraisal, Limits, Trajectory
from hil.report import colours
from hil.report.blocks import Panel
from hil.report.decimate import decimated
from hil.report.plotly_figures import Figure
from hil.report.traces import Trace, axes, line, markers

DEGREES = 180 / np.pi
POINTS = 240
"""Of a line: a page with twelve trajectories has hundreds of them."""


def motion_panels(trajectory: Trajectory, limits: Limits, names: Sequence[str]) -> list[Panel]:
    """Position, velocity, acceleration, jerk, torque and distance over time, with their limits."""
    samples, t = trajectory.samples, trajectory.samples.t
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
        Panel(title, _joints(t, values, names, y_title, float(limit)), _said(title, values, names))
        for title, y_title, values, limit in shown
    ]
    return [*panels, _distance(trajectory, limits.clearance_m)]


def singular_values(appraisal: Appraisal, random: Appraisal | None) -> Panel:
    """Singular values of the column-scaled regressor of all trajectories."""
    ours = appraisal.jointly.singular_values
    traces = [_ranked(ours, "these", colours.MEASURED, "circle")]
    if random is not None:
        theirs = random.jointly.singular_values
        traces.append(_ranked(theirs, "random", colours.PREDICTED, "diamond-open"))
    layout = axes("number, the largest first [1]", "singular value, scaled [1]")
    layout["yaxis"] |= {"type": "log", "dtick": "D2"}
    said = f"{len(ours)} singular values from {ours[0]:.2f} down to {ours[-1]:.2f}."
    return Panel("Singular values", {"data": traces, "layout": layout}, said)


def condition_by_number(appraisal: Appraisal, random: Appraisal | None) -> Panel:
    """Joint condition number of the first, the first two, … trajectories."""
    pairs = [(appraisal, "these", colours.MEASURED, "circle")]
    if random is not None:
        pairs.append((random, "random", colours.PREDICTED, "diamond-open"))
    traces = []
    for whose, name, colour, symbol in pairs:
        values = np.array([each.jointly.condition_scaled for each in whose.trajectories])
        traces.append(_ranked(values, name, colour, symbol))
    layout = axes("trajectories [1]", "condition, scaled [1]")
    layout["xaxis"]["dtick"] = 1
    first, *_, last = (each.jointly.condition_scaled for each in appraisal.trajectories * 2)
    said = f"From {first:.1f} with the first trajectory to {last:.1f} with all of them."
    return Panel("Condition number", {"data": traces, "layout": layout}, said)


def standard_errors(appraisal: Appraisal, random: Appraisal) -> Panel:
    """Standard errors of random draws over those of these trajectories, parameter by parameter."""
    ratio = random.jointly.standard_errors / appraisal.jointly.standard_errors
    order = np.argsort(ratio)
    names = [appraisal.jointly.names[i].split(" ")[0] for i in order]
    rank = np.arange(1.0, len(order) + 1)
    marks = markers(rank, ratio[order], "", colours.MEASURED, size=7, text=names, opacity=1.0)
    one = line(rank[[0, -1]], np.ones(2), "equal", colours.NEUTRAL, dash="dot")
    layout = axes("parameter, in this order [1]", "random over these [1]")
    layout["yaxis"]["rangemode"] = "tozero"
    said = f"Between {ratio.min():.2f} and {ratio.max():.2f}, {np.median(ratio):.2f} in the middle."
    return Panel("Standard errors", {"data": [one, marks], "layout": layout}, said)


def _joints(
    t: FloatArray, values: FloatArray, names: Sequence[str], y_title: str, limit: float
) -> Figure:
    traces = [
        line(*decimated(t, values[:, j], POINTS), name, colours.of_joint(j), dash=dash, width=1.5)
        for j, name in enumerate(names)
        for dash in (colours.dash_of_joint(j),)
    ]
    ends = t[[0, -1]]
    traces += [_limit(ends, sign * limit) for sign in (1, -1)]
    return {"data": traces, "layout": axes("time [s]", y_title)}


def _distance(trajectory: Trajectory, kept_m: float) -> Panel:
    t = trajectory.samples.t
    values = 1e3 * trajectory.clearance
    traces = [
        line(*decimated(t, values, POINTS), "distance", colours.RESIDUAL),
        _limit(t[[0, -1]], 1e3 * kept_m),
    ]
    layout = axes("time [s]", "distance [mm]")
    layout["yaxis"]["rangemode"] = "tozero"
    distance, bodies, at_s = trajectory.closest
    said = f"Least {1e3 * distance:.1f} mm between {' and '.join(bodies)} at {at_s:.2f} s."
    return Panel("Distance", {"data": traces, "layout": layout}, said)


def _limit(ends: FloatArray, value: float) -> Trace:
    return line(ends, np.full(2, value), "limit", colours.NEUTRAL, dash="dot", width=2.5)


def _ranked(values: FloatArray, name: str, colour: str, symbol: str) -> Trace:
    rank = np.arange(1.0, len(values) + 1)
    trace = line(rank, values, name, colour, width=1.5)
    look = {"symbol": symbol, "size": 6, "color": colour}
    return trace | {"mode": "lines+markers", "marker": look}


def _said(title: str, values: FloatArray, names: Sequence[str]) -> str:
    peaks = np.abs(values).max(axis=0)
    most = int(peaks.argmax())
    return f"{title} over time; the largest is {peaks[most]:.0f}, of {names[most]}."
