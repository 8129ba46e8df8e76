"""Figure builders: data in, a plotly figure as a plain dict out. Nothing here reads a file.

A figure is `{"data": [traces], "layout": {...}}` with numpy arrays as they are; `encode` turns it
into JSON. Colours come from `colours`, so that the page can change them for a dark screen. New
figures are new functions; `traces` holds what they are made of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from typing import Any, TypeAlias

import numpy as np

from hil.core import FloatArray, IntArray
from hil.report import colours
from hil.report.decimate import Shown, binned, decimated, in_parts, summarised, thinned
from hil.report.study_curves import look
from hil.report.traces import Trace, attempts, axes, band, corner, line, markers, span

Figure: TypeAlias = dict[str, Any]

POSE_LOOKS = (
    (colours.MEASURED, "circle", 5.0),
    (colours.PREDICTED, "diamond-open", 7.0),
    (colours.NEUTRAL, "x", 8.0),
)
"""Colour, marker and size of each group of `pose_map`, in order."""

CLOUD = 700
"""Points of a cloud: enough to see its shape, few enough to draw six of them at once."""


def measured_predicted(
    t: FloatArray, measured: FloatArray, predicted: FloatArray, unit: str, quantity: str
) -> Figure:
    """Measured and predicted effort of one joint over time, each (N,)."""
    return {
        "data": [
            line(*decimated(t, measured), "measured", colours.MEASURED, width=1.2),
            line(*decimated(t, predicted), "predicted", colours.PREDICTED, dash="dash", width=1.8),
        ],
        "layout": axes("time [s]", f"{quantity} [{unit}]"),
    }


def dwells(
    measured: FloatArray,
    predicted: FloatArray,
    approach: IntArray,
    pose: IntArray,
    unit: str,
    quantity: str,
) -> Figure:
    """Dwells of one joint ordered by what the model predicts; both approaches told apart.

    Args:
        measured: (D,) mean effort of each dwell.
        predicted: (D,) the same as the model has it.
        approach: (D,) +1 from below, −1 from above, 0 unknown.
        pose: (D,) pose numbers, for hovering.
        unit: Of the effort.
        quantity: What the effort is, for the axis.

    The distance between the two approaches at one place is the friction band of the joint.
    """
    order = np.argsort(predicted, kind="stable")
    rank = np.empty(len(order))
    rank[order] = np.arange(1, len(order) + 1)
    looks = (
        (1, "from below", colours.UP, "triangle-up"),
        (-1, "from above", colours.DOWN, "triangle-down"),
        (0, "measured", colours.MEASURED, "circle"),
    )
    traces = []
    for sign, name, colour, symbol in looks:
        rows = np.flatnonzero(approach == sign)
        if len(rows):
            label = [f"pose {p}" for p in pose[rows]]
            x, y, size = rank[rows], measured[rows], 2 + _mark_size(len(order))
            traces.append(markers(x, y, name, colour, symbol=symbol, size=size, text=label))
    x, y = decimated(np.sort(rank), predicted[order])
    traces.append(line(x, y, "predicted", colours.PREDICTED, width=2.2))
    title = "dwell, in the order of the prediction"
    return {"data": traces, "layout": axes(title, f"{quantity} [{unit}]")}


def residual_over(
    x: FloatArray, residual: FloatArray, x_title: str, unit: str, fast: float = float("nan")
) -> Figure:
    """Residual of one joint (N,) against anything (N,): the cloud, its mean and spread per bin.

    Args:
        x: What it is plotted against.
        residual: Measured minus predicted.
        x_title: Axis title with unit.
        unit: Of the residual.
        fast: RMS of the measured signal's high-frequency part, drawn as a band; NaN for none.
    """
    good = np.isfinite(x) & np.isfinite(residual)
    x, residual = x[good], residual[good]
    some = thinned(len(x), CLOUD)
    size = _mark_size(len(some))
    cloud = markers(x[some], residual[some], "sample", colours.NEUTRAL, size=size, opacity=0.65)
    layout = axes(x_title, f"residual [{unit}]")
    layout["shapes"] = band(fast)
    return {"data": [cloud, *_mean_and_spread(x, residual)], "layout": layout}


def residual_over_time(t: FloatArray, residual: FloatArray, unit: str, fast: float) -> Figure:
    """Residual of one joint (N,) over time: the line with its extremes, and a band of ± `fast`."""
    layout = axes("time [s]", f"residual [{unit}]")
    layout["shapes"] = band(fast)
    return {"data": [line(*decimated(t, residual), "residual", colours.RESIDUAL)], "layout": layout}


def regression(measured: FloatArray, predicted: FloatArray, unit: str) -> Figure:
    """Measured against predicted (N,) with the line of perfect agreement, R in the corner."""
    good = np.isfinite(measured) & np.isfinite(predicted)
    measured, predicted = measured[good], predicted[good]
    some = thinned(len(measured), CLOUD)
    low, high = span(np.concatenate([measured, predicted]))
    ends = np.array([low, high])
    layout = axes(f"predicted [{unit}]", f"measured [{unit}]")
    r = correlation(measured, predicted)
    layout["annotations"] = corner(
        f"R = {round(r, 4) + 0.0:.4f}" if np.isfinite(r) else "R undefined"
    )
    return {
        "data": [
            markers(
                predicted[some],
                measured[some],
                "sample",
                colours.MEASURED,
                size=_mark_size(len(some)),
            ),
            line(ends, ends, "measured = predicted", colours.PREDICTED, dash="dash"),
        ],
        "layout": layout,
    }


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Pearson's R of two (N,) signals where both are finite; NaN when one does not vary."""
    good = np.isfinite(a) & np.isfinite(b)
    a, b = a[good], b[good]
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def rmse_bars(
    joints: Sequence[str],
    values: Mapping[str, FloatArray],
    ticks: tuple[str, FloatArray],
    unit: str,
) -> Figure:
    """RMSE per joint, one group of bars per joint, one bar per estimator; named ticks across."""
    traces: list[Trace] = []
    names = [escape(joint) for joint in joints]
    for i, (name, rmse) in enumerate(values.items()):
        own = look(i)
        marker = {"color": own.colour, "pattern": {"shape": own.pattern}}
        traces.append(
            {"type": "bar", "name": escape(name), "x": names, "y": rmse, "marker": marker}
        )
    name, height = ticks
    if np.isfinite(height).any():
        mark = {
            "symbol": "line-ew-open",
            "size": 30,
            "color": colours.LIMIT,
            "line": {"width": 4},
        }
        traces.append(
            {"type": "scatter", "mode": "markers", "name": escape(name), "x": names,
             "y": height, "marker": mark}
        )  # fmt: skip
    layout = axes("joint", f"RMSE [{unit}]", barmode="group", showlegend=True)
    layout["xaxis"] |= {"dtick": 1}
    return {"data": traces, "layout": layout}


def joints_over_time(
    t: FloatArray,
    values: FloatArray,
    names: Sequence[str],
    y_title: str,
    *,
    limit: float = float("nan"),
    marked: bool = False,
    shown: Shown = "extremes",
    begins: Sequence[int] = (),
) -> Figure:
    """All joints (N, n) over time (N,) in one plot, lines differing in colour and dash.

    Args:
        t: Time [s].
        values: One column per joint; a joint that is NaN throughout is left out.
        names: Joint names, for hovering.
        y_title: Axis title with unit.
        limit: Drawn as a horizontal line; NaN for none.
        marked: Also draw the points (for few of them).
        shown: What is kept of many samples, see `decimate.summarised`.
        begins: Rows at which the attempts after the first begin; the lines are broken there.
    """
    traces = []
    for j, name in enumerate(names):
        if np.isnan(values[:, j]).all():
            continue
        x, y = in_parts(partial(summarised, shown=shown), t, values[:, j], begins)
        trace = line(x, y, name, colours.of_joint(j), dash=colours.dash_of_joint(j))
        if marked:
            trace["mode"] = "lines+markers"
            trace["marker"] = {"symbol": colours.symbol_of_joint(j), "size": 6}
        traces.append(trace)
    layout = axes("time [s]", y_title) | attempts(t[list(begins)])
    if np.isfinite(limit):
        traces.append(
            line(t[[0, -1]], np.full(2, limit), "limit", colours.NEUTRAL, dash="dot", width=2.5)
        )
    return {"data": traces, "layout": layout}


def over_time(
    t: FloatArray, value: FloatArray, y_title: str, j: int = 0, begins: Sequence[int] = ()
) -> Figure:
    """One signal (N,) over time in the colour of joint `j`, broken where attempts begin."""
    x, y = in_parts(decimated, t, value, begins)
    trace = line(x, y, y_title, colours.of_joint(j), width=1.0)
    return {"data": [trace], "layout": axes("time [s]", y_title) | attempts(t[list(begins)])}


def coverage(x: FloatArray, y: FloatArray, x_title: str, y_title: str, cells: int = 48) -> Figure:
    """How often (x, y) was visited: a grid of counts on a logarithmic scale, empty cells blank."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    (x_low, x_high), (y_low, y_high) = span(x), span(y)
    column = np.clip(((x - x_low) / (x_high - x_low) * cells).astype(np.int64), 0, cells - 1)
    row = np.clip(((y - y_low) / (y_high - y_low) * cells).astype(np.int64), 0, cells - 1)
    count = np.bincount(row * cells + column, minlength=cells * cells).reshape(cells, cells)
    centre = (np.arange(cells) + 0.5) / cells
    trace = {
        "type": "heatmap",
        "x": x_low + centre * (x_high - x_low),
        "y": y_low + centre * (y_high - y_low),
        "z": np.where(count > 0, np.log10(np.maximum(count, 1)), np.nan),
        "colorscale": [[0, colours.SELDOM], [1, colours.OFTEN]],
        "colorbar": _counts(int(count.max())),
        "hovertemplate": "%{x:.3g}, %{y:.3g}: 10^%{z:.1f} samples<extra></extra>",
    }
    return {"data": [trace], "layout": axes(x_title, y_title)}


def pose_map(
    x: FloatArray,
    y: FloatArray,
    groups: Mapping[str, IntArray],
    x_title: str,
    y_title: str,
) -> Figure:
    """Poses seen along two joints; `groups` names the rows of each kind (trained, held out, …)."""
    traces = [
        markers(x[rows], y[rows], name, colour, symbol=symbol, size=size, opacity=0.85)
        for (name, rows), (colour, symbol, size) in zip(groups.items(), POSE_LOOKS, strict=False)
        if len(rows)
    ]
    return {"data": traces, "layout": axes(x_title, y_title)}


def _counts(most: int) -> dict[str, Any]:
    """The scale of a grid of counts, in powers of ten and their halves."""
    shown = [n for k in range(8) for n in (10**k, 3 * 10**k) if n <= most]
    return {
        "title": {"text": "samples [1]", "side": "right"},
        "tickvals": [float(np.log10(n)) for n in shown],
        "ticktext": [str(n) for n in shown],
        "thickness": 9,
        "outlinewidth": 0,
    }


def _mark_size(points: int) -> float:
    """Few marks are drawn large, many small [px]."""
    return 3.0 if points > 300 else 4.0 if points > 100 else 6.0


def _mean_and_spread(x: FloatArray, y: FloatArray) -> list[Trace]:
    centre, mean, spread = binned(x, y)
    if len(centre) < 2:
        return []
    edges = ((mean + spread, "mean + 1 SD"), (mean - spread, "mean − 1 SD"))
    return [
        *(
            line(centre, edge, name, colours.PREDICTED, dash="dot", width=1.2)
            for edge, name in edges
        ),
        line(centre, mean, "mean", colours.PREDICTED, width=2.2),
    ]
