"""Figures of a fleet's page: a mark per robot, over age and over temperature."""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.models import Standing, Survey
from hil.report import colours
from hil.report.blocks import Panel, Plots
from hil.report.plotly_figures import Figure
from hil.report.traces import axes, line, markers
from hil.report.words import joint_title

AXES = {"age": "time in service [years]", "temperature": "joint temperature [°C]"}


def plots(
    survey: Survey, key: str, which: Standing | None, y: FloatArray, shown: list[int], over: str,
    y_title: str,
) -> Plots | None:  # fmt: skip
    """A quantity over age or temperature, a panel per joint; None where that is not known.

    Args:
        survey: Of the fleet.
        key: `friction` or `change`.
        which: How the robots stand in it.
        y: (S, n) of the robots that are shown.
        shown: (S,) which they are.
        over: A key of `AXES`.
        y_title: Of the axis.
    """
    robots = [survey.robots[k] for k in shown]
    names = robots[0].joint_names
    if over == "age":
        x = np.repeat(np.array([one.age for one in robots])[:, None], len(names), axis=1)
    else:
        x = np.array([one.temperature for one in robots])
    if not np.isfinite(x).any():
        return None
    out = np.zeros(y.shape, dtype=bool) if which is None else which.outlying[shown]
    panels = tuple(
        Panel(
            joint_title(j, name),
            _figure(x[:, j], y[:, j], out[:, j], [one.robot for one in robots], over, y_title,
                    _line(which, over, j, x[:, j], y[:, j])),
            f"{y_title} of {name} over {AXES[over]}, a mark per robot",
        )
        for j, name in enumerate(names)
    )  # fmt: skip
    legend = (
        ("robot", colours.MEASURED, "●"),
        ("stands out", colours.PREDICTED, "◆"),
        ("what is expected", colours.NEUTRAL, "dash"),
    )[: 3 if which is not None and over in which.names else 2]
    title = {"friction": "Friction", "change": "Change of friction"}[key]
    return Plots(f"{title} over {over}", "", panels, legend)


def _line(
    which: Standing | None, over: str, j: int, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """The trend over one quantity through the middle of the fleet, the others at their mean."""
    if which is None or over not in which.names:
        return None
    told = np.isfinite(x) & np.isfinite(y)
    x, y = x[told], y[told]
    slope = which.slopes[which.names.index(over), j]
    middle = np.median(np.log(y) - slope * (x - x.mean()))
    ends = np.linspace(x.min(), x.max(), 20)
    return ends, np.exp(middle + slope * (ends - x.mean()))


def _figure(
    x: FloatArray, y: FloatArray, out: BoolArray, names: list[str], over: str, y_title: str,
    trend: tuple[FloatArray, FloatArray] | None,
) -> Figure:  # fmt: skip
    traces = []
    for rows, name, colour, symbol, size in (
        (np.flatnonzero(~out), "robot", colours.MEASURED, "circle", 5.0),
        (np.flatnonzero(out), "stands out", colours.PREDICTED, "diamond", 9.0),
    ):
        if len(rows):
            text = [names[i] for i in rows]
            traces.append(
                markers(x[rows], y[rows], name, colour, symbol=symbol, size=size, text=text)
            )
    if trend is not None:
        traces.append(line(*trend, "what is expected", colours.NEUTRAL, dash="dash"))
    return {"data": traces, "layout": axes(AXES[over], y_title)}
