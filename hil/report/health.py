"""The section about the recording: continuity, tracking, temperature, drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil.report import colours
from hil.report import plotly_figures as figures
from hil.report.blocks import Block, Column, Facts, Panel, Plots, Section, Table, cells, items
from hil.report.decimate import Shown
from hil.report.documents import as_float
from hil.report.facts import RunFacts
from hil.report.recording import Drift, Recording
from hil.report.weighing import weighings
from hil.report.words import LATE, count, duration, joint_title, number

DEGREES = 180 / np.pi

NEAR_LIMIT = 0.6
"""Values above this share of a limit are shown together with it."""


def health(
    facts: RunFacts, recording: Recording, drift: Drift | None, names: Sequence[str]
) -> Section:
    """How good the recording is."""
    unit = facts.effort_unit
    blocks: list[Block] = [
        _continuity(facts, recording),
        *_weighings(facts),
        _ranges(recording, drift, names, unit),
        _over_time(facts, recording, drift, names),
    ]
    return Section("recording", "Recording health", "", tuple(blocks))


def _continuity(facts: RunFacts, recording: Recording) -> Facts:
    counts = recording.counts
    # A stop document tells the wall time of its own attempt only.
    wall = as_float(None if recording.begins else facts.stop.get("wall_s"))
    measured, nominal = number(recording.measured_rate_hz, 5), number(recording.rate_hz, 5)
    missing = f"{counts.missing} samples, {number(recording.gaps_percent, 2)} %"
    said = {
        "samples": count(counts.samples),
        "recorded time": duration(recording.recorded_s),
        "attempts": len(recording.attempts) if recording.begins else None,
        "rate": f"{measured} Hz (nominal {nominal} Hz)",
        "gaps": f"{counts.gaps} ({missing})",
        "duplicates": counts.duplicates,
        "late samples": f"{counts.overruns} ({LATE})" if counts.overruns else 0,
        "dwells that did not settle": len(facts.unsettled) if facts.indices("dwell") else None,
        "wall time": duration(wall) if np.isfinite(wall) else None,
        "speed": _speed(recording.recorded_s, wall),
    }
    return Facts("Continuity", items(said))


def _weighings(facts: RunFacts) -> list[Block]:
    """What was weighed; nothing for a run without a sweep over loads."""
    told = weighings(facts)
    return [Facts("Loads as weighed", items(told))] if told else []


def _speed(device: float, wall: float) -> str | None:
    return f"{number(device / wall)} × real time" if wall > 0 else None


def _ranges(recording: Recording, drift: Drift | None, names: Sequence[str], unit: str) -> Table:
    q, qd = recording.rows["q"] * DEGREES, recording.rows["qd"] * DEGREES
    error, heat = 1e3 * recording.tracking_error(), recording.rows["temperature"]
    table: list[tuple[Column, FloatArray]] = [
        (Column("from [°]", "position"), _over_rows(np.min, q)),
        (Column("to [°]", "position"), _over_rows(np.max, q)),
        (Column("peak [°/s]", "velocity"), _over_rows(np.max, np.abs(qd))),
        (Column("RMS [mrad]", "tracking error"), np.sqrt(_over_rows(np.mean, error**2))),
        (Column("peak [mrad]", "tracking error"), _over_rows(np.max, np.abs(error))),
        (Column("start [°C]", "temperature"), heat[0]),
        (Column("end [°C]", "temperature"), heat[-1]),
    ]
    if drift is not None:
        largest = _over_rows(np.max, np.abs(drift.change))
        table.append((Column(f"largest change [{unit}]", "reference pose"), largest))
    rows = tuple(
        cells(joint_title(j, name), *(number(float(values[j])) for _, values in table))
        for j, name in enumerate(names)
    )
    columns = (Column("joint", number=False), *(column for column, _ in table))
    caption = "Ranges per joint over the whole recording"
    return Table(caption, columns, rows).without_empty_columns()


def _over_rows(what: np.ufunc | object, values: FloatArray) -> FloatArray:
    """A statistic per joint over the finite rows; NaN for a joint without any."""
    assert callable(what)
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([float(what(column)) if len(column) else np.nan for column in columns])


def _over_time(
    facts: RunFacts, recording: Recording, drift: Drift | None, names: Sequence[str]
) -> Plots:
    """What changes over the run, under one legend."""
    titles = [joint_title(j, name) for j, name in enumerate(names)]
    panels = tuple(_panels(facts, recording, drift, titles))
    drawn = {trace["name"] for panel in panels for trace in panel.figure["data"]}
    legend = [
        (title, colours.of_joint(j), colours.dash_of_joint(j)) for j, title in enumerate(titles)
    ]
    limit = [("limit", colours.NEUTRAL, "dot")] if "limit" in drawn else []
    return Plots("Over time", "", panels, (*legend, *limit))


def _panels(
    facts: RunFacts, recording: Recording, drift: Drift | None, names: Sequence[str]
) -> list[Panel]:
    t, panels, begins = recording.t, [], recording.begins
    error = 1e3 * np.abs(recording.tracking_error())
    if np.isfinite(error).any():
        limit = 1e3 * facts.interlock_limit("tracking_error", "limit_rad")
        panels.append(_wide("Tracking error", t, error, names, "mrad", limit, "upper", begins))
    heat = recording.rows["temperature"]
    if np.isfinite(heat).any():
        limit = facts.interlock_limit("temperature", "limit_c")
        panels.append(_wide("Joint temperature", t, heat, names, "°C", limit, "mean", begins))
    if drift is not None:
        panels += _drift(drift, names, facts.effort_unit)
    panels.append(_interval(recording))
    return panels


def _wide(
    title: str,
    t: FloatArray,
    values: FloatArray,
    names: Sequence[str],
    unit: str,
    limit: float,
    shown: Shown,
    begins: Sequence[int],
) -> Panel:
    peak = _peak(values)
    # A limit far above the data would press them flat; then it is only said.
    drawn = limit if peak > NEAR_LIMIT * limit else float("nan")
    axis = f"{title.lower()} [{unit}]"
    figure = figures.joints_over_time(
        t, values, names, axis, limit=drawn, shown=shown, begins=begins
    )
    alt = f"{title} of all joints over time; the largest value is {number(peak)} {unit}."
    said = f"{title}, limit {limit:g} {unit}" if np.isfinite(limit) else title
    return Panel(said, figure, alt, wide=True)


def _drift(drift: Drift, names: Sequence[str], unit: str) -> list[Panel]:
    """One panel for each side the reference pose was approached from."""
    words = {1: ", approached from below", -1: ", approached from above", 0: ""}
    panels = []
    for side, said in words.items():
        rows = drift.approach == side
        if rows.sum() < 2:
            continue
        t, change = drift.t[rows], drift.change[rows]
        figure = figures.joints_over_time(t, change, names, f"change [{unit}]", marked=True)
        alt = f"{len(t)} visits, largest change {number(_peak(np.abs(change)))} {unit}."
        title = f"Drift at the reference pose{said}: effort since the first visit"
        panels.append(Panel(title, figure, f"{title}. {alt}", wide=True))
    return panels


def _interval(recording: Recording) -> Panel:
    steps, begins = 1e3 * np.diff(recording.t), [row - 1 for row in recording.begins]
    steps[begins] = np.nan  # a pause between attempts is no interval
    figure = figures.over_time(recording.t[1:], steps, "interval [ms]", begins=begins)
    alt = f"Time between samples by the robot's clock, at most {number(_peak(steps))} ms."
    return Panel("Time between samples by the robot's clock", figure, alt, wide=True)


def _peak(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else float("nan")
