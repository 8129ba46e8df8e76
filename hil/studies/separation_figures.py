"""Curves and panels of a separation study, with no more points than a page shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset, correlation
from hil.estimators import StaticLinear
from hil.studies.figure import Curve, Figure, Panel, Style
from hil.studies.separation_text import joint_titles

MOST = 700
"""Points of a panel, all curves together."""

IN_A_ROW = 80
"""Of efforts that jump from row to row, more cannot be told apart."""

ROW = f"The first {IN_A_ROW} in order of time."
GIVEN = (
    "The intervals hold for the scatter between poses. What all poses share (friction that "
    "differs by side or load, gains that are off) is not in them: on the mock with all effects "
    "they hold about half of the true values."
)


def joint_angles(whole: Dataset) -> Figure:
    """Fig. 3: where each joint was, over time."""
    rows = spaced(len(whole), MOST)
    t = whole["t"][rows] - whole["t"][0]
    panels = [
        Panel(title, "time [s]", "angle [rad]", (line("measured", t, whole["q"][rows, j]),))
        for j, title in enumerate(joint_titles(whole.n_joints))
    ]
    caption = f"The whole program, moves included: {len(rows)} of {len(whole)} samples."
    return Figure("fig-3", "Joint angles over time", caption, tuple(panels), 3)


def parameters(key: str, model: StaticLinear, caption: str) -> Figure:
    """Fig. 4: parameters of joint 2's gravity, with 95 % intervals clustered by pose."""
    chosen = [k for k, name in enumerate(model.parameter_names_) if name.startswith("joint2.phi")]
    # Paper form: the joint by itself, in the unit of the effort.
    scale = model.torque_scale_[1]
    values = model.coefficients_[chosen] / scale
    reach = np.diff(model.interval(0.95)[chosen], axis=1)[:, 0] / 2 / scale
    names = tuple(f"θ2,{k + 1}" for k in range(len(chosen)))
    unit = "A" if model.effort_kind_ == "current" else "N·m"
    curve = Curve("WLS", names, floats(values), "bars", floats(reach))
    panel = Panel("θ₂ with 95 % intervals", "parameter", f"value [{unit}]", (curve,))
    return Figure(key, "Parameters of joint 2's gravity by WLS", f"{caption} {GIVEN}", (panel,), 1)


def series(
    key: str,
    title: str,
    caption: str,
    curves: Mapping[str, FloatArray],
    joints: Sequence[int],
    axes: tuple[str, str],
) -> Figure:
    """Fig. 5 and 8: the first rows of efforts (N, n) by name.

    What was measured, the first curve, is a line; a single estimate beside it is points, several
    are lines, because points would hide each other.
    """
    style: Style = "line" if len(curves) > 2 else "points"
    rows = np.arange(min(IN_A_ROW, *(len(values) for values in curves.values())))
    panels = []
    for j in joints:
        found = [
            line(name, rows, values[rows, j], style if k else "line")
            for k, (name, values) in enumerate(curves.items())
        ]
        panels.append(Panel(f"J{j + 1}", *axes, tuple(found)))
    return Figure(key, title, caption, tuple(panels), 2)


def regression(
    key: str,
    title: str,
    caption: str,
    sets: Mapping[str, tuple[FloatArray, FloatArray]],
    axes: tuple[str, str],
) -> Figure:
    """Fig. 7: estimated over measured (N,), one panel per set, with R of all of its points."""
    panels = []
    for name, (measured, estimated) in sets.items():
        known = np.isfinite(measured) & np.isfinite(estimated)
        x, y = measured[known], estimated[known]
        rows = spaced(len(x), MOST)
        r = float(correlation(x[:, None], y[:, None])[0])
        curves = (points("estimates", x[rows], y[rows]), identity())
        panels.append(Panel(name, *axes, curves, corner=f"R = {r:.4f}"))
    return Figure(key, title, caption, tuple(panels), 2)


def clouds(
    key: str,
    title: str,
    caption: str,
    x: FloatArray,
    ys: Mapping[str, FloatArray],
    axes: tuple[str, str],
) -> Figure:
    """One panel per joint with clouds (P, n) over x (P, n)."""
    rows = spaced(len(x), MOST // max(len(ys), 1))
    panels = [
        Panel(name, *axes, tuple(points(words, x[rows, j], y[rows, j]) for words, y in ys.items()))
        for j, name in enumerate(joint_titles(x.shape[1]))
    ]
    return Figure(key, title, caption, tuple(panels), 3)


def line(name: str, x: FloatArray | IntArray, y: FloatArray, style: Style = "line") -> Curve:
    """A curve of arrays."""
    return Curve(name, floats(x), floats(y), style)


def points(name: str, x: FloatArray, y: FloatArray) -> Curve:
    """A cloud of points."""
    return line(name, x, y, "points")


def identity() -> Curve:
    """The line on which estimates would be right."""
    return Curve("estimated = measured", style="identity")


def floats(values: FloatArray | IntArray) -> tuple[float, ...]:
    """Plain numbers, with as many digits as anybody can see."""
    return tuple(float(f"{number:.6g}") for number in np.asarray(values).tolist())


def spaced(count: int, most: int) -> IntArray:
    """At most so many of so many rows, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
