"""Figures of a separation study: those of the paper, and the same under the honest protocol.

`paper_figures` and `honest_figures` choose what is shown; the functions below them make panels of
curves, with no more points than a page shows.
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


OURS = ("hysteresis", "network-approach", "coulomb", "network", "gravity", "wls")
"""What is shown as the model in the honest figures: the first of them that was fitted."""

IN_A_ROW = 80
"""Of efforts that jump from row to row, more cannot be told apart."""

ROW = f"The first {IN_A_ROW} in order of time."


def paper_figures(run: PaperRun, joint: int) -> tuple[Figure, ...]:
    """Figures 4, 5, 7 and 8; `joint` from 0 beside joint 1 in Fig. 5, and in Fig. 7."""
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
        parameters("fig-4", run.wls.model, "Of eq. 20: gravity over K₁, in amperes. The six "
                   "columns of φ₂ repeat each other, so single parameters are uncertain where "
                   "their sum is not."),
        series("fig-5", "Measured and estimated currents", "Five methods on eq. 20, the measured "
               "current among their inputs.", {"measured": current[test], **linear},
               sorted({0, joint}), axes),
        regression("fig-7", f"Regression plots of J{joint + 1}", "Gravity and friction together; "
                   "each point is a sample, and each pose is in both panels.", fitted,
                   ("measured [A]", "estimated [A]")),
        series("fig-8", "Performance of the static model", "Measured and modelled currents of "
               "test samples, whose poses were trained on.", modelled,
               range(run.data.n_joints), axes),
    )  # fmt: skip


def honest_figures(
    recording: Recording, run: HonestRun, both: Bands | None, joint: int, weights: Weights
) -> tuple[Figure, ...]:
    """The same with whole poses held out, and what the approach leaves in the current."""
    unit = run.dwells.effort_unit
    effort, axes = f"effort [{unit}]", "dwell held out, in order of time"
    found = _parameters(recording, weights)
    linear = {
        WORDS[method]: run.methods[method].effort for method in METHODS if method in run.methods
    }
    if linear:
        found.append(
            series("fig-5h", "Measured and estimated efforts", "The five methods without the "
                   "measured current, at poses they have not seen. Their lines lie on each "
                   f"other. {ROW}",
                   {"measured": run.measured, **linear}, sorted({0, joint}), (axes, effort))
        )  # fmt: skip
    best = next((key for key in OURS if key in run.methods), next(iter(run.methods)))
    chosen = [run.methods[key] for key in dict.fromkeys(("network", best)) if key in run.methods]
    sets = {one.method.words: (run.measured[:, joint], one.effort[:, joint]) for one in chosen}
    modelled = {"measured": run.measured, "modelled": run.methods[best].effort}
    found += [
        regression("fig-7h", f"Regression plots of J{joint + 1}", "Poses not seen; each point "
                   "is the mean of a dwell.", sets,
                   (f"measured [{unit}]", f"estimated [{unit}]")),
        series("fig-8h", "Performance of the static model", "Measured and modelled means of "
               f"dwells at poses not seen; the model: {run.methods[best].method.words}. {ROW}",
               modelled, range(run.dwells.n_joints), (axes, effort)),
    ]  # fmt: skip
    if both is not None:
        found.append(_band(both))
    return tuple(found)


def _parameters(recording: Recording, weights: Weights) -> list[Figure]:
    """Fig. 4 without the current among the regressors; nothing for arms eq. 15 is not for."""
    model = StaticLinear(method="wls", form="paper", weights=weights)
    try:
        model.fit(recording.dwells, recording.robot)
    except HilError:
        return []
    caption = "From the mean of every dwell, both approaches, nothing measured among the inputs."
    return [parameters("fig-4h", model, caption)]


def _band(both: Bands) -> Figure:
    curves: dict[str, FloatArray] = {"measured": both.measured.half}
    curves |= {SHORT[key]: both.predicted[key].half for key in reversed(friction_of(both))}
    known = both.common
    shown = {name: np.where(known, half, np.nan) for name, half in curves.items()}
    return clouds(
        "fig-band",
        "Half the difference of both approaches over the load",
        "Stick friction of a pose, measured and as predicted for poses not seen.",
        both.load,
        shown,
        (f"load [{both.unit}]", f"half difference [{both.unit}]"),
    )


MOST = 700
"""Points of a panel, all curves together."""

GIVEN = (
    "The intervals hold for the scatter between poses. What all poses share (friction that "
    "differs by side or load, gains that are off) is not in them: on the mock with all effects "
    "they hold about half of the true values."
)
