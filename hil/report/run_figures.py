"""Figures of a run: figures of its motion and figures of its recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from hil.core import FloatArray, IntArray, StructArray
from hil.data import Dataset
from hil.report import colours
from hil.report.curves import Shown as Summary
from hil.report.curves import decimated, in_parts, span, summarised, thinned
from hil.report.documents import as_index
from hil.report.figure_list import DEGREES, figure
from hil.report.run_facts import RunFacts
from hil.report.run_recording import Recording, ReferenceDrift, intervals
from hil.report.words import joint_title, number
from hil.studies import Curve, Figure, Grid, Look, Mark, Panel


@dataclass(frozen=True, slots=True, eq=False)
class RunView:
    """Data for the figures of a run.

    Attributes:
        facts: Contents of the small files of the run.
        recording: Samples of all attempts of the run.
        drift: Change of effort at the reference pose; None if no visit of this pose was repeated.
        names: Joint names, n in total.
        held_out: Series on which each model was evaluated; their poses are marked in the pose map.
    """

    facts: RunFacts
    recording: Recording
    drift: ReferenceDrift | None
    names: Sequence[str]
    held_out: Sequence[Dataset] = ()


# --- The motion of a run -------------------------------------------------------------------------

COVERAGE_ROWS = 60_000
"""Maximum number of rows in the coverage figure, evenly spread over the recording."""


@figure("excitation")
def joint_angles(view: RunView) -> Figure:
    """Return the figure of the joint angles over time."""
    q: FloatArray = view.recording.rows["q"] * DEGREES
    panels = tuple(
        Panel(
            joint_title(j, name),
            "time [s]",
            "position [°]",
            (_broken_line(view.recording, q[:, j], j),),
            alt=f"Position of {name} over time, {q[:, j].min():.0f}° to {q[:, j].max():.0f}°.",
            marks=_attempts(view.recording),
        )
        for j, name in enumerate(view.names)
    )
    return Figure("angles", "Joint angles over time", "", panels, 0)


@figure("excitation")
def pose_map(view: RunView) -> Figure | None:
    """Return the figure of the poses of a dwell program, for pairs of joints.

    The figure distinguishes poses for training, held-out poses, and poses whose dwell did not
    settle.
    """
    poses, where = _dwell_poses(view.facts, view.recording)
    names = view.names
    if not len(poses) or len(names) < 2:
        return None
    unsettled = np.isin(poses, view.facts.unsettled)
    kept_away = {c.pose for data in view.held_out for c in data.conditions if c.kind == "dwell"}
    held = np.isin(poses, list(kept_away)) & ~unsettled
    groups = (
        ("trained on" if view.facts.judged_fits else "measured", ~held & ~unsettled,
         Look(colours.MEASURED, size=5, opacity=0.85)),
        ("held out", held, Look(colours.PREDICTED, symbol="diamond-open", size=7, opacity=0.85)),
        ("not settled", unsettled, Look(colours.NEUTRAL, symbol="x", size=8, opacity=0.85)),
    )  # fmt: skip
    degrees = where * DEGREES

    def panel(a: int, b: int) -> Panel:
        curves = tuple(
            Curve(name, degrees[rows, a], degrees[rows, b], "points", look=look)
            for name, rows, look in groups
            if rows.any()
        )
        alt = f"{len(poses)} poses along {names[a]} and {names[b]}."
        titles = (f"J{a + 1} and J{b + 1}", f"J{a + 1} position [°]", f"J{b + 1} position [°]")
        return Panel(*titles, curves, alt=alt)

    # With an odd number of joints, the last joint is paired with the one before it.
    firsts = (min(j, len(names) - 2) for j in range(0, len(names), 2))
    panels = tuple(panel(j, j + 1) for j in firsts)
    lead = f"The {len(poses)} poses of the dwells."
    return Figure("pose-map", "Pose map", lead, panels, 0)


def _dwell_poses(facts: RunFacts, recording: Recording) -> tuple[IntArray, FloatArray]:
    """Return pose numbers (P,) and joint angles (P, n) [rad] of the dwells, one row per pose."""
    poses, where = [], []
    segment = recording.rows["segment"].astype(np.int64)
    for _, last in intervals(segment, np.array(facts.indices("dwell"), dtype=np.int64)):
        poses.append(as_index(facts.steps[int(segment[last - 1])].get("pose")))
        where.append(recording.rows["q"][last - 1])
    if not poses:
        return np.empty(0, np.int64), np.empty((0, 0))
    number, first = np.unique(np.array(poses), return_index=True)
    return number, np.array(where)[first]


@figure("excitation")
def position_velocity_coverage(view: RunView) -> Figure:
    """Return the figure of the number of samples per position and velocity of each joint."""
    rows = view.recording.rows
    on_trajectories = _rows_of_steps(rows, view.facts.indices("trajectory"))
    chosen = on_trajectories if len(on_trajectories) else rows
    chosen = chosen[thinned(len(chosen), COVERAGE_ROWS)]
    q, qd = chosen["q"] * DEGREES, chosen["qd"] * DEGREES
    panels = tuple(
        Panel(
            joint_title(j, name),
            "position [°]",
            "velocity [°/s]",
            (),
            alt=f"Position–velocity coverage of {name}, up to {np.abs(qd[:, j]).max():.0f} °/s.",
            grid=counted_grid(q[:, j], qd[:, j]),
        )
        for j, name in enumerate(view.names)
    )
    when = "on the trajectories" if len(on_trajectories) else "in the whole run"
    lead = f"Number of samples per position and velocity {when}; darker cells have more samples."
    return Figure("coverage", "Position and velocity coverage", lead, panels, 0)


def _rows_of_steps(rows: StructArray, steps: Sequence[int]) -> StructArray:
    """Return the recorded rows whose plan step is in a list of steps."""
    selected = np.zeros(max(steps, default=-1) + 2, np.bool_)
    selected[list(steps)] = True
    segment = np.clip(rows["segment"], -1, len(selected) - 1)
    chosen: StructArray = rows[selected[segment]]
    return chosen


CELLS = 48
"""Number of cells of a grid along each axis."""


def counted_grid(x: FloatArray, y: FloatArray) -> Grid:
    """Count the finite points (x, y), each (N,), in every cell; empty cells are NaN."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    (x_low, x_high), (y_low, y_high) = span(x), span(y)
    column = np.clip(((x - x_low) / (x_high - x_low) * CELLS).astype(np.int64), 0, CELLS - 1)
    row = np.clip(((y - y_low) / (y_high - y_low) * CELLS).astype(np.int64), 0, CELLS - 1)
    count = np.bincount(row * CELLS + column, minlength=CELLS * CELLS).reshape(CELLS, CELLS)
    centre = (np.arange(CELLS) + 0.5) / CELLS
    return Grid(
        x_low + centre * (x_high - x_low),
        y_low + centre * (y_high - y_low),
        np.where(count > 0, np.log10(np.maximum(count, 1)), np.nan),
    )


# --- The recording of a run ----------------------------------------------------------------------

NEAR_LIMIT = 0.6
"""Share of a limit: if values exceed this share of the limit, the limit is also drawn."""


@figure("recording")
def over_time(view: RunView) -> Figure:
    """Return the figure of following error, temperature, drift and sample interval over time."""
    recording, panels = view.recording, list[Panel]()
    error = 1e3 * np.abs(recording.tracking_error())
    if np.isfinite(error).any():
        limit = 1e3 * view.facts.interlock_limit("tracking_error", "limit_rad")
        panels.append(_of_all_joints(view, "Tracking error", error, "mrad", limit, "upper"))
    heat = recording.rows["temperature"]
    if np.isfinite(heat).any():
        limit = view.facts.interlock_limit("temperature", "limit_c")
        panels.append(_of_all_joints(view, "Joint temperature", heat, "°C", limit, "mean"))
    panels += [*_drift(view), _interval(recording)]
    return Figure("over-time", "Over time", "", tuple(panels), 1)


def _of_all_joints(
    view: RunView, title: str, values: FloatArray, unit: str, limit: float, shown: Summary
) -> Panel:
    t, peak = view.recording.t, _peak(values)
    curves = joint_curves(t, values, view.names, shown=shown, begins=view.recording.attempt_starts)
    # A limit far above the data would compress the curves; the title then states it instead.
    if peak > NEAR_LIMIT * limit:
        curves.append(limit_line(t[[0, -1]], limit))
    return Panel(
        f"{title}, limit {limit:g} {unit}" if np.isfinite(limit) else title,
        "time [s]",
        f"{title.lower()} [{unit}]",
        tuple(curves),
        alt=f"{title} of all joints over time; the largest value is {number(peak)} {unit}.",
        wide=True,
        marks=_attempts(view.recording),
    )


def _drift(view: RunView) -> list[Panel]:
    """Return the drift panels, one panel per approach direction of the reference pose."""
    if view.drift is None:
        return []
    unit, panels = view.facts.effort_unit, []
    words = {1: ", approached from below", -1: ", approached from above", 0: ""}
    for side, said in words.items():
        rows = view.drift.approach == side
        if rows.sum() < 2:
            continue
        t, change = view.drift.t[rows], view.drift.change[rows]
        alt = f"{len(t)} visits, largest change {number(_peak(np.abs(change)))} {unit}."
        title = f"Drift at the reference pose{said}: effort since the first visit"
        curves = tuple(joint_curves(t, change, view.names, marked=True))
        axes = ("time [s]", f"change [{unit}]")
        panels.append(Panel(title, *axes, curves, alt=f"{title}. {alt}", wide=True))
    return panels


def _interval(recording: Recording) -> Panel:
    steps = np.append(np.nan, 1e3 * np.diff(recording.t))
    steps[list(recording.attempt_starts)] = np.nan  # a pause between attempts is not an interval
    title = "Sample interval by the clock of the robot"
    return Panel(
        title,
        "time [s]",
        "interval [ms]",
        (_broken_line(recording, steps),),
        alt=f"{title}, at most {number(_peak(steps))} ms.",
        wide=True,
        marks=_attempts(recording),
    )


def joint_curves(
    t: FloatArray,
    values: FloatArray,
    names: Sequence[str],
    *,
    marked: bool = False,
    shown: Summary = "extremes",
    begins: Sequence[int] = (),
) -> list[Curve]:
    """Return curves of all joints (N, n) over time (N,), with different colours and dash patterns.

    Args:
        t: Time [s].
        values: Values with one column per joint; a joint with only NaN is omitted.
        names: Joint names.
        marked: Whether to draw markers at the points, which is suitable for few points.
        shown: Kind of reduction of many samples, as in `curves.summarised`.
        begins: First row of each attempt except the first attempt; lines are interrupted at these
            rows.
    """
    curves = []
    for j, name in enumerate(names):
        if not np.isnan(values[:, j]).all():
            x, y = in_parts(partial(summarised, shown=shown), t, values[:, j], begins)
            style: Literal["marked", "line"] = "marked" if marked else "line"
            curves.append(Curve(joint_title(j, name), x, y, style, look=colours.of_joint(j)))
    return curves


def limit_line(ends: FloatArray, value: float) -> Curve:
    """Return a curve that draws a limit as a horizontal line."""
    look = Look(colours.NEUTRAL, "dot", width=2.5)
    return Curve("limit", ends, np.full(2, value), look=look)


def _broken_line(recording: Recording, values: FloatArray, j: int = 0) -> Curve:
    """Return the curve of one signal (N,) over time, interrupted between attempts."""
    x, y = in_parts(decimated, recording.t, values, recording.attempt_starts)
    return Curve("", x, y, look=Look(colours.of_joint(j).colour, width=1.0))


def _attempts(recording: Recording) -> tuple[Mark, ...]:
    """Return marks at the start of each attempt except the first attempt."""
    times = recording.t[list(recording.attempt_starts)]
    return tuple(Mark(float(t), f"attempt {i}") for i, t in enumerate(times, 2))


def _peak(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else float("nan")
