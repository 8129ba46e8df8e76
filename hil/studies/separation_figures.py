"""Figures of the separation study: the figures of the static paper, under two protocols.

The functions `paper_figures` and `honest_figures` select the figures of each protocol. The other
functions create panels of curves and limit the number of points that a page displays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hil.core import FloatArray, HilError, IntArray
from hil.data import Dataset, correlation
from hil.estimators import StaticLinear, Weights
from hil.studies.figure import Curve, Figure, Panel, Style
from hil.studies.result import joint_titles
from hil.studies.separation_data import Recording
from hil.studies.separation_honest import SHORT, Bands, HonestRun, friction_of
from hil.studies.separation_paper import METHODS, PaperRun
from hil.studies.separation_tables import WORDS


def joint_angles(whole: Dataset) -> Figure:
    """Return Fig. 3: joint angles over time."""
    rows = spaced(len(whole), MOST)
    t = whole["t"][rows] - whole["t"][0]
    panels = [
        Panel(title, "time [s]", "angle [rad]", (line("measured", t, whole["q"][rows, j]),))
        for j, title in enumerate(joint_titles(whole.n_joints))
    ]
    caption = f"The whole program including moves: {len(rows)} of {len(whole)} samples."
    return Figure("fig-3", "Joint angles over time", caption, tuple(panels), 3)


def parameters(key: str, model: StaticLinear, caption: str) -> Figure:
    """Return Fig. 4: gravity parameters of joint 2 with 95 % intervals clustered by pose."""
    chosen = [k for k, name in enumerate(model.parameter_names_) if name.startswith("joint2.phi")]
    # Convert to the form of the static paper: parameters in the unit of the effort.
    scale = model.torque_scale_[1]
    values = model.coefficients_[chosen] / scale
    reach = np.diff(model.interval(0.95)[chosen], axis=1)[:, 0] / 2 / scale
    names = tuple(f"θ2,{k + 1}" for k in range(len(chosen)))
    unit = "A" if model.effort_kind_ == "current" else "N·m"
    curve = Curve("WLS", names, floats(values), "bars", floats(reach))
    panel = Panel("θ₂ with 95 % intervals", "parameter", f"value [{unit}]", (curve,))
    return Figure(key, "Gravity parameters of joint 2 by WLS", f"{caption} {GIVEN}", (panel,), 1)


def series(
    key: str,
    title: str,
    caption: str,
    curves: Mapping[str, FloatArray],
    joints: Sequence[int],
    axes: tuple[str, str],
) -> Figure:
    """Return Fig. 5 or 8: the first rows of several efforts (N, n), each with its name.

    The first curve of the figure is the measured effort, drawn as a line. A single estimated effort
    is drawn as points. Several estimated efforts are drawn as lines, because points would hide each
    other.
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
    """Return Fig. 7: estimated over measured effort (N,), with one panel per set of rows.

    Each panel shows the correlation coefficient R of all points of its set.
    """
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
    """Return a figure with one panel per joint that shows point clouds (P, n) over x (P, n)."""
    rows = spaced(len(x), MOST // max(len(ys), 1))
    panels = [
        Panel(name, *axes, tuple(points(words, x[rows, j], y[rows, j]) for words, y in ys.items()))
        for j, name in enumerate(joint_titles(x.shape[1]))
    ]
    return Figure(key, title, caption, tuple(panels), 3)


def line(name: str, x: FloatArray | IntArray, y: FloatArray, style: Style = "line") -> Curve:
    """Return a curve from arrays of x and y values."""
    return Curve(name, floats(x), floats(y), style)


def points(name: str, x: FloatArray, y: FloatArray) -> Curve:
    """Return a point cloud from arrays of x and y values."""
    return line(name, x, y, "points")


def identity() -> Curve:
    """Return the curve y = x, on which estimated and measured values are equal."""
    return Curve("estimated = measured", style="identity")


def floats(values: FloatArray | IntArray) -> tuple[float, ...]:
    """Return values as floats that are rounded to six significant digits."""
    return tuple(float(f"{number:.6g}") for number in np.asarray(values).tolist())


def spaced(count: int, most: int) -> IntArray:
    """Return at most `most` evenly spaced row numbers out of `count` rows."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


OURS = ("hysteresis", "network-approach", "coulomb", "network", "gravity", "wls")
"""Keys of methods in order of preference; honest figures show the first method that was fitted."""

IN_A_ROW = 80
"""Maximum number of rows of a drawn series.

A reader cannot distinguish more rows, because efforts vary strongly from row to row.
"""

ROW = f"The figure shows the first {IN_A_ROW} in order of time."


def paper_figures(run: PaperRun, joint: int) -> tuple[Figure, ...]:
    """Return figures 4, 5, 7 and 8 of the static paper.

    The argument `joint` (counted from 0) selects the joint of Fig. 7, and of Fig. 5 in addition to
    joint 1.
    """
    current, test, train = run.data["effort"], run.partition.test, run.partition.train
    whole = run.wls.estimate + run.separated().friction
    axes = ("test sample, in order of time", "current [A]")
    linear = {WORDS[method]: run.linear[method].estimate[test] for method in METHODS}
    fitted = {
        "a) training samples": (current[train, joint], whole[train, joint]),
        "b) test samples": (current[test, joint], whole[test, joint]),
    }
    modelled = {"measured": current[test], "WLS and networks": whole[test]}
    return (
        parameters("fig-4", run.wls.model, "Parameters of eq. 20: gravity divided by K₁, in "
                   "amperes. The six columns of φ₂ are nearly dependent, so that single parameters "
                   "are uncertain although their sum is not."),
        series("fig-5", "Measured and estimated currents", "Five methods on eq. 20, with the "
               "measured current among their inputs.", {"measured": current[test], **linear},
               sorted({0, joint}), axes),
        regression("fig-7", f"Regression plots of J{joint + 1}", "Sum of gravity and friction; "
                   "each point is a sample, and each pose occurs in both panels.", fitted,
                   ("measured [A]", "estimated [A]")),
        series("fig-8", "Performance of the static model", "Measured and modelled currents of "
               "test samples, whose poses are among the training poses.", modelled,
               range(run.data.n_joints), axes),
    )  # fmt: skip


def honest_figures(
    recording: Recording, run: HonestRun, both: Bands | None, joint: int, weights: Weights
) -> tuple[Figure, ...]:
    """Return figures 4, 5, 7 and 8 for held-out poses, and the friction band over the load."""
    unit = run.dwells.effort_unit
    effort, axes = f"effort [{unit}]", "held-out dwell, in order of time"
    found = _parameters(recording, weights)
    linear = {
        WORDS[method]: run.methods[method].effort for method in METHODS if method in run.methods
    }
    if linear:
        found.append(
            series("fig-5h", "Measured and estimated efforts", "The five methods without the "
                   f"measured current, at held-out poses. Their lines coincide. {ROW}",
                   {"measured": run.measured, **linear}, sorted({0, joint}), (axes, effort))
        )  # fmt: skip
    best = next((key for key in OURS if key in run.methods), next(iter(run.methods)))
    chosen = [run.methods[key] for key in dict.fromkeys(("network", best)) if key in run.methods]
    sets = {one.method.words: (run.measured[:, joint], one.effort[:, joint]) for one in chosen}
    modelled = {"measured": run.measured, "modelled": run.methods[best].effort}
    found += [
        regression("fig-7h", f"Regression plots of J{joint + 1}", "Held-out poses; each point "
                   "is the mean of a dwell.", sets,
                   (f"measured [{unit}]", f"estimated [{unit}]")),
        series("fig-8h", "Performance of the static model", "Measured and modelled means of "
               f"dwells at held-out poses. Model: {run.methods[best].method.words}. {ROW}",
               modelled, range(run.dwells.n_joints), (axes, effort)),
    ]  # fmt: skip
    if both is not None:
        found.append(_band(both))
    return tuple(found)


def _parameters(recording: Recording, weights: Weights) -> list[Figure]:
    """Return Fig. 4 for fits without the motor current among the regressors.

    The result is empty if eq. 15 does not apply to the arm.
    """
    model = StaticLinear(method="wls", form="paper", weights=weights)
    try:
        model.fit(recording.dwells, recording.robot)
    except HilError:
        return []
    caption = (
        "Fitted to the mean of every dwell, from both approach directions, without measured "
        "current among the inputs."
    )
    return [parameters("fig-4h", model, caption)]


def _band(both: Bands) -> Figure:
    curves: dict[str, FloatArray] = {"measured": both.measured.half}
    curves |= {SHORT[key]: both.predicted[key].half for key in reversed(friction_of(both))}
    known = both.common
    shown = {name: np.where(known, half, np.nan) for name, half in curves.items()}
    return clouds(
        "fig-band",
        "Half the difference of both approaches over the load",
        "Static friction of a pose, measured, and predicted for held-out poses.",
        both.load,
        shown,
        (f"load [{both.unit}]", f"half difference [{both.unit}]"),
    )


MOST = 700
"""Maximum number of points in a panel, summed over all curves."""

GIVEN = (
    "The intervals include the scatter between poses only. They do not include errors common to "
    "all poses (friction that depends on approach direction or load, wrong drive gains): on the "
    "mock with all effects, they contain about half of the true values."
)
